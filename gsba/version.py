"""The version of gsba: part of every stage's key, of reports and of folder markers."""

__version__ = "0.1.0"
