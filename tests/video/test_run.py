"""A video refined in one call is its extracted folder, refined."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from refusals import refused
from tiny_run import SETTINGS, Case, computed_stages
from video_files import encode, steady, times_of
from wave_panorama import wave_panorama

from gsba import refine
from gsba.config import RefineSettings, VideoSettings
from gsba.masks.merging import choose
from gsba.pipeline.inputs import extract_video
from gsba.store import RunStore
from gsba.video import extract

pytest.importorskip("av", reason="PyAV is not installed")


@pytest.mark.slow
def test_video_and_folder_give_the_same(case: Case, tmp_path: Path) -> None:
    video = tmp_path / "walk.mp4"
    walk = case.result.frames
    pictures = [cv2.cvtColor(cv2.imread(str(p)), cv2.COLOR_BGR2RGB) for (p,) in walk.paths]
    encode(video, (pictures, np.rint(90_000 * walk.timestamps)))
    settings = SETTINGS.model_copy(update={"video": VideoSettings(every=1)})
    out = tmp_path / "from-video"
    direct = refine(video, case.slam, out, settings)
    extract(video, tmp_path / "frames", settings.video)
    folder = refine(tmp_path / "frames", case.slam, tmp_path / "from-folder", settings)
    np.testing.assert_array_equal(
        direct.reconstruction.world_T_rigs, folder.reconstruction.world_T_rigs
    )
    np.testing.assert_allclose(
        direct.frames.timestamps, walk.timestamps - walk.timestamps[0], atol=1e-4
    )
    assert case.errors(out).ate.rmse < 3 * case.errors().ate.rmse  # as good as from the images

    assert computed_stages(refine(video, case.slam, out, settings)) == []  # resumed


def test_where_odometry_is_lost_frames_are_stills(tmp_path: Path) -> None:
    video, settings = tmp_path / "lapse.mp4", RefineSettings()
    encode(video, ([wave_panorama(256, seed) for seed in range(8)], steady(8)))
    with RunStore(tmp_path / "run", {"frames": video}) as store:
        found = extract_video(store, video, settings, None, choose("none"))
    assert found is None
    assert len(times_of(tmp_path / "run/frames")) == 8  # at one a second it would be one


def test_bad_input_fails_before_decoding(tmp_path: Path) -> None:
    video, slam, run = (tmp_path / name for name in ("walk.mp4", "slam.tum", "run"))
    video.write_bytes(b"no video")
    refused(r"nowhere\.tum", refine, video, tmp_path / "nowhere.tum", run)
    slam.write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    refused(r"walk\.mp4: cannot be read as video", refine, video, slam, run)
    refused("--fps 0: must be a positive", refine, video, slam, run, fps=0)
