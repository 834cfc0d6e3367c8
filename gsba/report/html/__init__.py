"""report.html: a run as one self-contained page."""

from gsba.report.html.page import write_html
from gsba.report.html.views import residual_sphere

__all__ = ["residual_sphere", "write_html"]
