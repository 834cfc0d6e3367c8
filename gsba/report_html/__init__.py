"""report.html: a run as one self-contained page."""

from gsba.report_html.page import write_html
from gsba.report_html.views import residual_sphere

__all__ = ["residual_sphere", "write_html"]
