"""report.html: the report of a run as one self-contained page.

Takes the report, the result and its frames.
Gives one file that holds its figures and images.
"""

from gsba.report.html.figures import residual_sphere
from gsba.report.html.page import add_odometry, add_scan, add_splats, write_html

__all__ = ["add_odometry", "add_scan", "add_splats", "residual_sphere", "write_html"]
