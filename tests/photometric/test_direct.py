"""Patches on the sphere, their depths from the map, and the stage in a run."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from photometric_world import Texture, planes_from, render
from synthetic import unit
from tiny_run import BARE, Case, computed_stages

from factors.patch_windows import PatchTable, patch_spans, pixel_grid
from gsba.bundle import adjustment
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Bearings, Families, Family, MapSnapshot
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.camera.lens import Lenses
from gsba.camera.sphere import erp_from_bearings
from gsba.config import RefineSettings
from gsba.config_file import load_config
from gsba.disk import write_image
from gsba.frames import cubemap
from gsba.frames.masks import levels_of
from gsba.log import GsbaError
from gsba.photometric import direct, patches
from gsba.photometric.direct import PhotometricResult
from gsba.pipeline.run import Run
from gsba.store.store import load_stage
from gsba.types import FrameSet, Keypoints, Solution

WIDTH = 512
GREY = render(np.eye(4), Texture(np.random.default_rng(0)), WIDTH).astype(np.float32)
ALL = np.ones(GREY.shape, bool)
JOINT = RefineSettings.model_validate({**BARE.model_dump(), "factors": ("bearing", "photometric")})


def test_patches_are_spread_over_the_sphere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patches, "_SPACING_DEG", 10)
    bearings = patches.candidates(GREY, ALL)
    assert np.allclose(np.linalg.norm(bearings, axis=1), 1)
    # 4 pi / (10 deg)^2 cells, those beyond 80 degrees of latitude left empty
    assert 370 < len(bearings) < 430
    octants = np.bincount((bearings > 0) @ [1, 2, 4], minlength=8)
    assert octants.min() > 0.8 * octants.max()


def test_masked_flat_and_saturated_places_have_no_patch() -> None:
    usable = ALL.copy()
    usable[:, :200] = False
    bearings = patches.candidates(GREY, usable)
    u = erp_from_bearings(bearings, WIDTH, WIDTH // 2)[:, 0]
    reach = patches._SIZE // 2
    assert len(bearings) and (u > 200 + reach).all() and (u < WIDTH - reach).all()
    assert len(patches.candidates(np.full_like(GREY, 90), ALL)) == 0
    assert len(patches.candidates(GREY, ~ALL)) == 0


def test_coarser_masks_want_all_pixels() -> None:
    usable = np.ones((4, 8), bool)
    usable[3, 5] = False
    assert np.array_equal(patches.coarser(usable, 2), [[1, 1, 1, 1], [1, 1, 0, 1]])


def test_planes_pass_through_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    normal, offset = unit(np.array([0.3, -0.2, 1.0])), 3.0
    rays = unit(np.array([0, 0, 1.0]) + 0.25 * rng.normal(size=(400, 3)))
    points = rays * (offset / (rays @ normal))[:, None]
    points[::15] *= 1.5  # of another surface
    bearings = unit(np.array([0, 0, 1.0]) + 0.05 * rng.normal(size=(50, 3)))
    monkeypatch.setattr(patches, "SLOPE_SIGMA", 10.0)
    planes, clear = patches.lay_planes(bearings, points)
    assert np.count_nonzero(clear) > 40
    expected = bearings @ normal / offset
    assert np.abs(planes[clear, 0] / expected[clear] - 1).max() < 0.01


def test_a_map_without_points_near_gives_no_depth() -> None:
    rng = np.random.default_rng(2)
    bearings = unit(np.array([0, 0, -1.0]) + 0.05 * rng.normal(size=(5, 3)))
    points = 3 * unit(np.array([0, 0, 1.0]) + 0.05 * rng.normal(size=(100, 3)))
    assert not patches.lay_planes(bearings, points)[1].any()
    assert not patches.lay_planes(bearings, points[:3])[1].any()
    scattered = unit(rng.normal(size=(200, 3))) * rng.uniform(1, 30, (200, 1))
    anywhere = unit(rng.normal(size=(50, 3)))
    clear = patches.lay_planes(anywhere, scattered)[1]
    assert np.count_nonzero(clear) < 10


def test_lenses_see_patches_where_they_show_their_points() -> None:
    """From 200 random bearings of three frames, of planes that face them."""
    rng = np.random.default_rng(5)
    lenses = Lenses(np.array([0.001, 0, 0.04]), 0.2, np.deg2rad(4))
    world_T_rigs = np.stack([gtsam.Pose3.Expmap(0.2 * rng.normal(size=6)).matrix() for _ in "123"])
    hosts, bearings = rng.integers(0, 3, 200), unit(rng.normal(size=(200, 3)))
    planes = planes_from(bearings, rng.uniform(1, 5, 200))
    table = PatchTable(
        hosts, bearings, planes, np.ones((200, 3)), np.arange(201), (hosts + 1) % 3,
        pixel_grid(5, 0.01),
    )  # fmt: skip
    seen = replace(table, views=patches.views_of(table, world_T_rigs, lenses))
    shown = unit(patch_spans(seen, world_T_rigs, planes, np.arange(200))[:, 0])
    rays, starts = lenses.rays(bearings, hosts)
    # as far along the ray as the plane is from the lens
    local = starts + rays / planes[:, :1]
    to = np.linalg.inv(world_T_rigs[table.targets]) @ world_T_rigs[hosts]
    points = np.einsum("nij,nj->ni", to[:, :3, :3], local) + to[:, :3, 3]
    expected = unit(lenses.seeing(points, table.targets))
    np.testing.assert_allclose(shown, expected, atol=1e-9)


@pytest.fixture(scope="module")
def joint(case: Case, tmp_path_factory: pytest.TempPathFactory):
    """The case's run, taken further by the photometric family."""
    out = case.copy(tmp_path_factory.mktemp("photometric") / "run")
    return case.refine(out, JOINT), out


def test_a_finished_run_goes_on(case: Case, joint) -> None:
    result, out = joint
    assert computed_stages(result)[0] == "photometric"
    before, after = case.errors(), case.errors(out)
    # a walk of eight 512 px frames, aligned patches before: about .5 and .6
    assert after.rotation_deg.rmse < 0.75 * before.rotation_deg.rmse
    assert after.ate.rmse < 0.8 * before.ate.rmse


def test_the_report_tells_of_patches(joint) -> None:
    result, _ = joint
    stage = next(s for s in result.report["stages"] if s["name"] == "photometric")
    taken, seen = stage["counts"]
    assert taken["unit"] == "patches" and seen["unit"] == "patch observations"
    for counts in (taken, seen):
        assert counts["received"] == counts["kept"] + sum(counts["dropped"].values())
        assert counts["kept"] > 100
    last = result.report["solver"][-1]
    costs = last["rounds"][-1]["iterations"][0]["costs"]
    assert last["stage"] == "photometric" and {"bearing", "photometric", "graph"} == set(costs)


def _start(case: Case, settings: RefineSettings):
    frames = load_stage(case.out, "frames", FrameSet)
    solved = load_stage(case.out, "refined1", Solution)
    keypoints = load_stage(case.out, "keypoints", Keypoints)
    priors = TrajectoryPrior(case.result.coarse.world_T_rigs, settings.priors)
    return frames, keypoints, solved, priors, cubemap.rig_for(frames.format, settings.cubemap)


def _refined(case: Case) -> tuple[Solution, PhotometricResult]:
    frames, keypoints, solved, priors, rig = _start(case, JOINT)
    context = AdjustmentContext(Families((Bearings(), priors)), rig, JOINT, 1)
    return solved, direct.refine(frames, keypoints, solved, context)


def test_nothing_to_see_changes_nothing(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patches, "_MIN_GRADIENT", 1e3)
    monkeypatch.setattr(direct, "_DEPTH_LEVELS", 0)
    solved, result = _refined(case)
    assert np.array_equal(result.adjustment.world_T_rigs, solved.world_T_rigs)
    assert all(counts.kept == 0 for counts in result.counts)


def test_observations_weigh_what_both_masks_say(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(direct, "_DEPTH_LEVELS", 0)
    monkeypatch.setattr(patches, "_SPACING_DEG", 10)
    frames, _, solved, *_ = _start(case, JOINT)
    half = np.ones((frames.format.height, frames.format.width))
    half[:, : frames.format.width // 2] = 0.5
    write_image(tmp_path / "half.png", levels_of(half))
    masked = replace(frames, mask_paths=(tmp_path / "half.png",) * len(frames))
    plain, ones, _ = direct._patches(frames, solved, 1, Lenses())
    pixels, trust, _ = direct._patches(masked, solved, 1, Lenses())
    assert plain is not None and pixels is not None and (ones == 1).all()
    table = pixels.table
    points = table.bearings_rig / table.planes[:, :1]  # planes that face their hosts
    hosts, targets = solved.world_T_rigs[table.hosts], solved.world_T_rigs[table.targets]
    world = np.einsum("pij,pj->pi", hosts[:, :3, :3], points) + hosts[:, :3, 3]
    seen = np.einsum("oji,oj->oi", targets[:, :3, :3], world[table.owners] - targets[:, :3, 3])
    expected = patches.values_at(half, table.bearings_rig)[table.owners]
    expected *= patches.values_at(half, seen)
    assert set(expected) == {0.25, 0.5, 1.0}
    assert np.mean(np.abs(trust - expected) < 0.01) > 0.99  # others are at the border
    block = direct.make_block(pixels, trust, 1)
    whole = direct.make_block(pixels, np.ones(len(trust)), 1)
    values = adjustment.values_of(solved.world_T_rigs)
    for one in (block, whole):
        one.refresh(values)
    assert block.costs(values)["photometric"] < whole.costs(values)["photometric"]


def test_a_solve_against_the_map_is_undone(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(direct, "_MAX_GROWTH", 1e-3)
    monkeypatch.setattr(direct, "_DEPTH_LEVELS", 0)
    monkeypatch.setattr(patches, "_SPACING_DEG", 20)
    solved, result = _refined(case)
    assert not result.adjustment.rounds[-1].accepted
    assert np.array_equal(result.adjustment.world_T_rigs, solved.world_T_rigs)


class Offset(Family):
    """A variable that is measured as one, and starts at zero."""

    name, digest = "offset", "1"

    def variables(self, snapshot: MapSnapshot) -> gtsam.Values:
        values = gtsam.Values()
        values.insert(gtsam.symbol("B", 0), np.zeros(1))
        return values

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        graph, unit_noise = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(1)
        graph.add(gtsam.PriorFactorVector(gtsam.symbol("B", 0), np.ones(1), unit_noise))
        return graph


@pytest.mark.parametrize("supported", [True, False])
def test_variables_of_families_are_undone_with_the_poses(
    case: Case, monkeypatch: pytest.MonkeyPatch, supported: bool
) -> None:
    """A solve that is cheaper, but leaves frames with too few points, left its variables."""
    monkeypatch.setattr(direct, "_MAX_GROWTH", 1e3)
    monkeypatch.setattr(direct, "_DEPTH_LEVELS", 0)
    monkeypatch.setattr(patches, "_SPACING_DEG", 20)
    monkeypatch.setattr(Solution, "carries", lambda *_: supported)
    frames, keypoints, solved, priors, rig = _start(case, JOINT)
    families = Families((Bearings(), priors, Offset()), frames.names, frames.timestamps)
    context = AdjustmentContext(families, rig, JOINT, 1)
    found = direct.refine(frames, keypoints, solved, context).adjustment
    assert found.rounds[-1].accepted == supported
    if supported:
        assert found.variables is not None and np.allclose(found.variables.data, 1.0, atol=0.01)
    else:
        assert found.variables is solved.variables


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layout": "cube", "faces": ("front",)}, "not cube faces"),
        ({"width": 510, "height": 255}, "not 255 rows"),
    ],
)
def test_other_frames_are_refused_before_any_work(case: Case, change: dict, message: str) -> None:
    frames, *_ = _start(case, JOINT)
    direct.check(frames, JOINT)
    with pytest.raises(GsbaError, match=message):
        other = frames.with_formats([replace(frames.format, **change)])
        Run.begin(None, other, None, JOINT)  # type: ignore[arg-type]


def test_a_small_panorama_has_fewer_levels(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(direct, "_DEPTH_LEVELS", 9)
    monkeypatch.setattr(patches, "_SPACING_DEG", 20)
    monkeypatch.setattr(patches, "_SIZE", 5)
    _, result = _refined(case)
    assert np.isfinite(result.adjustment.world_T_rigs).all() and len(result.counts) == 2


def test_the_family_needs_another() -> None:
    with pytest.raises(GsbaError, match="photometric needs bearing or reprojection"):
        load_config(None, ['factors=["photometric"]'])


def test_wide_panoramas_are_halved(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patches, "_MAX_WIDTH", 256)
    frames, *_ = _start(case, JOINT)
    levels, usable = patches.pyramid(frames, 0, 2)
    assert [level.shape for level in levels] == [(128, 256), (64, 128), (32, 64)]
    assert usable.shape == (128, 256)


def test_a_doubted_frame_loses_weight() -> None:
    class Block:
        """What the rule looks at."""

        keys = range(3)
        counted = np.ones(60, bool)

        class table:
            targets = np.repeat([0, 1, 2], 20)
            hosts = np.array([0, 1, 2])
            owners = np.repeat([0, 1, 2], 20)

        def errors(self, _values: gtsam.Values) -> np.ndarray:
            return np.repeat([1.0, 1.0, 36.0], 20)

    values = gtsam.Values()
    rule = direct._frame_weights
    weights, residuals = rule(Block(), values, np.ones(3))  # type: ignore[arg-type]
    assert np.allclose(residuals, [1, 1, 6]) and np.allclose(weights, [1, 1, 1 / 9])
    pulled = rule(Block(), values, np.array([2.4, 1.0, 1.0]))[0]  # type: ignore[arg-type]
    assert np.allclose(pulled, [1 / 4, 1, 1 / 9])
