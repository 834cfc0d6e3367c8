"""report.html: a run as one self-contained page."""

from gsba.report_html.page import write_html

__all__ = ["write_html"]
