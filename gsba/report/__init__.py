"""Reports of a run and of its accuracy: report.json, poses.csv, report.html.

Takes the result, the findings of stages and their cost.
Gives plain values, and a self-contained page.
"""

from gsba.report.report import FrameQuality, build_report, frame_quality, write_poses

__all__ = ["FrameQuality", "build_report", "frame_quality", "write_poses"]
