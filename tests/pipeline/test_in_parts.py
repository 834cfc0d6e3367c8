"""A run whose adjustments are cut into parts, beside the undivided one."""

from pathlib import Path

import pytest
from tiny_run import NUM_FRAMES, Case, computed_stages, settings_with

from gsba.bundle.adjustment import DivisibleMap
from gsba.bundle.optimizer import OptimizeResult, SolverOptions
from gsba.parts import adjustments


def test_a_run_in_parts_is_as_good_and_leaves_none_behind(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # So few frames see one another: nearly all of them lie on cuts.
    monkeypatch.setattr(adjustments, "_MAX_CUT_SHARE", 1.0)
    minimized, used = adjustments.DividedAdjustments.minimized, list[bool]()

    def noted(
        self: adjustments.DividedAdjustments, map_: DivisibleMap, options: SolverOptions
    ) -> OptimizeResult | None:
        found = minimized(self, map_, options)
        used.append(found is not None)
        return found

    monkeypatch.setattr(adjustments.DividedAdjustments, "minimized", noted)
    solver = {"part_frames": NUM_FRAMES // 2}
    settings = settings_with(solver=solver, export={"formats": ()})
    result = case.refine(tmp_path / "run", settings)
    assert len(used) > 3 and all(used)
    case.assert_as_good(tmp_path / "run")
    assert not (tmp_path / "run/stages/parts").exists()
    assert "reconstruction" in computed_stages(result)
    again = case.refine(tmp_path / "run", settings)
    assert not computed_stages(again)
