"""A local page around the library: choose footage, run commands, watch them, look at results.

Takes a folder whose files may be chosen, the forms of commands, and a port of this machine.
Gives a server for browsers of this machine; jobs are processes that outlive it.
"""

from gsba.app.forms import Field, Form
from gsba.app.hub import App
from gsba.app.server import serve, state_folder

__all__ = ["App", "Field", "Form", "serve", "state_folder"]
