"""What a run did and how good it is: report.json, poses.csv, report.html.

Takes the result, what was found on the way, and what stages cost.
Gives plain values, and a page that explains itself.
"""

from gsba.report.report import FrameQuality, build_report, frame_quality, write_poses

__all__ = ["FrameQuality", "build_report", "frame_quality", "write_poses"]
