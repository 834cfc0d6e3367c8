"""Interactive 3D view of a finished run in the browser.

Takes the folder of a run.
Gives a page on a local port, until it is stopped.
"""

from gsba.view.display import SceneView
from gsba.view.scene import RunScene, Splat, faces_of, files_of_scene, load_scene
from gsba.view.server import serve

__all__ = ["RunScene", "SceneView", "Splat", "faces_of", "files_of_scene", "load_scene", "serve"]
