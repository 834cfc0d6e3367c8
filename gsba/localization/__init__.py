"""Localisation of new frames in a finished run.

Takes a finished run and pictures.
Gives poses with covariances; the run stays as it is.
"""

from gsba.localization.localizer import LocalizedFrame, Localizer

__all__ = ["LocalizedFrame", "Localizer"]
