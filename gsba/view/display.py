"""Nodes of a scene in the browser, and the controls that change them."""

import io
from contextlib import redirect_stdout
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from gsba.camera.views import View as Face
from gsba.geometry import extent_of, quaternion_from_rotation
from gsba.log import GsbaError
from gsba.report.report import frame_quality
from gsba.types import PoseStatus
from gsba.view.scene import RunScene, faces_of, views_of

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]

_BEFORE, _AFTER, _BAD = (217, 130, 43), (23, 105, 170), (192, 57, 43)  # colours of report.html
_SEEN = (46, 125, 79)
_RECORDINGS = (_AFTER, _BEFORE, _SEEN, (142, 79, 168), (160, 103, 47), (93, 125, 139))  # by turns


class SceneView:
    """View of a scene on a running server, with its nodes and controls.

    Nodes are in the scene's world times `scale`, so that steps are about 1 if the world is not
    metric: viewers have fixed near and far planes.
    """

    def __init__(self, server: "viser.ViserServer", scene: RunScene, address: str) -> None:
        self.server, self.scene, self.address = server, scene, address
        self.scale = 1.0 if scene.unit == "m" else 1.0 / scene.step
        self.size = self.scale * scene.step  # of a drawn rig
        self.frame = -1  # shown frame
        self.nodes: dict[str, Any] = {}  # handles by name of the scene node
        self.controls: dict[str, Any] = {}  # handles by label
        self._faces: dict[str, Any] = {}
        self._masked = False
        self._lock = Lock()
        self._quality = frame_quality(scene.reconstruction)
        with server.atomic():
            server.scene.set_up_direction(scene.up)
            found = self.scene.reconstruction
            self._add_points("/cloud", found.points_world, found.point_colors, 0.02)
            if self.scene.judged is not None:
                points, colors = self.scene.judged
                self._add_points("/judged", points, colors, 0.025, visible=False)
            self._add_paths()
            self._add_splats()
            self._add_controls()
            camera, (position, centre) = self.server.initial_camera, self._outside()
            camera.up, camera.position, camera.look_at = tuple(self.scene.up), position, centre
        self.show(0)

    def show(self, f: int) -> None:
        """Show the images of a frame at its pose, and the points that it observes."""
        with self._lock:
            masked = bool(self.controls["Masks"].value)
            if (f, masked) == (self.frame, self._masked):
                return
            self.frame, self._masked = f, masked
            try:
                faces, problem = faces_of(self.scene.frames, f, masked, self.scene.optics), ""
            except GsbaError as error:
                faces, problem = {}, str(error)
            with self.server.atomic():
                # Place images around the rig of a frame, and the points that it observes
                add, found = self.server.scene, self.scene.reconstruction
                world_T_rig = found.world_T_rigs[f]
                position = self.scale * world_T_rig[:3, 3]
                wxyz = quaternion_from_rotation(world_T_rig[:3, :3])
                if "/frame" not in self.nodes:
                    self.nodes["/frame"] = add.add_frame("/frame", show_axes=False)
                self.nodes["/frame"].wxyz, self.nodes["/frame"].position = wxyz, position
                for view in views_of(self.scene.frames, f, self.scene.optics):
                    self._place_face(f, view, faces.get(view.name))
                rows = found.observation_points[found.observation_frames == f]
                shown = bool(self.controls["Observed points"].value)
                self._add_points("/seen", found.points_world[rows], _SEEN, 0.035, shown)
                self.controls["about"].content = self._about(f, problem)

    def stop(self) -> None:
        """Stop the server without output."""
        with redirect_stdout(io.StringIO()):  # viser prints a message
            self.server.stop()

    def _add_points(
        self, name: str, points: np.ndarray, colors: Any, size: float, visible: bool = True
    ) -> None:
        """Add points (N, 3) of a size in steps."""
        self.nodes[name] = self.server.scene.add_point_cloud(
            name,
            (self.scale * points).astype(np.float32),
            colors,
            point_size=size * self.size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
            visible=visible,
        )

    def _add_paths(self) -> None:
        """Add lines through the poses before and after, and a forward-facing pyramid per rig."""
        world_T_rigs = self.scene.reconstruction.world_T_rigs
        coarse = self.scene.coarse_T_rigs
        numbers = self.scene.frames.recording_of_frame
        own = np.array(_RECORDINGS, np.uint8)[numbers % len(_RECORDINGS)]
        self._add_line("/refined", world_T_rigs, own)
        if coarse is not None:
            self._add_line("/coarse", coarse, np.full_like(own, _BEFORE))
        wxyz = quaternion_from_rotation(world_T_rigs[:, :3, :3]).astype(np.float32)
        positions = (self.scale * world_T_rigs[:, :3, 3]).astype(np.float32)
        refined = self.scene.reconstruction.pose_statuses == PoseStatus.REFINED
        rigs = self.server.scene.add_batched_meshes_simple(
            "/rigs",
            *_pyramid(0.22 * self.size),
            wxyz,
            positions,
            batched_colors=np.where(refined[:, None], own, _BAD).astype(np.uint8),
            opacity=0.75,
            flat_shading=True,
            side="double",
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        rigs.on_click(lambda event: self._select(event.instance_index))
        self.nodes["/rigs"] = rigs
        self.nodes["/axes"] = self.server.scene.add_batched_axes(
            "/axes",
            wxyz,
            positions,
            axes_length=0.3 * self.size,
            axes_radius=0.012 * self.size,
            visible=False,
        )

    def _add_line(self, name: str, world_T_rigs: np.ndarray, colors: np.ndarray) -> None:
        """Add a line through poses (F, 4, 4) in colours (F, 3), broken between recordings."""
        positions = (self.scale * world_T_rigs[:, :3, 3]).astype(np.float32)
        ends = [rows[-1] for rows in self.scene.frames.recordings.values()]
        kept = np.setdiff1d(np.arange(len(positions) - 1), ends)
        segments = np.stack([positions[kept], positions[kept + 1]], axis=1)
        self.nodes[name] = self.server.scene.add_line_segments(
            name, segments, np.stack([colors[kept]] * 2, axis=1), thickness=0.03 * self.size
        )

    def _add_splats(self) -> None:
        for splat in self.scene.splats:
            name = f"/splat/{splat.name}"
            self.nodes[name] = self.server.scene.add_gaussian_splats(
                name,
                self.scale * splat.means,
                self.scale**2 * splat.covariances,
                splat.colors,
                splat.opacities,
                visible=False,
            )

    def _add_controls(self) -> None:
        gui, scene = self.server.gui, self.scene
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=_AFTER)
        num = len(scene.reconstruction.points_world)
        about = f"{len(scene.frames)} frames, {num} points, {scene.grounds} ({scene.unit})"
        gui.add_markdown(f"## {scene.name}\n{about}")
        panel = gui.add_panel()  # on phones it begins folded, so that the scene has room
        with panel.add_tab("Frame"):
            slider = gui.add_slider("Number", 0, len(scene.frames) - 1, 1, 0)
            slider.on_update(lambda _: self.show(int(slider.value)))
            self.controls["Number"] = slider
            self.controls["about"] = gui.add_markdown("")
            inside = gui.add_button(
                "Stand inside", hint="Move to the frame and look at its images from inside."
            )
            inside.on_click(lambda event: self._stand(event.client, inside=True))
            whole = gui.add_button("Show the whole run")
            whole.on_click(lambda event: self._stand(event.client, inside=False))
            self._add_switch("Images", "/frame")
            self._add_switch("Observed points", "/seen")
            masks = gui.add_checkbox(
                "Masks", False, visible=any(path is not None for path in scene.frames.mask_paths)
            )
            masks.on_update(lambda _: self.show(self.frame))
            self.controls["Masks"] = masks
        with panel.add_tab("Run"):
            self._add_switch("Refined trajectory", "/refined")
            self._add_switch(f"Start: {scene.start}", "/coarse")
            self._add_switch("Rigs", "/rigs")
            self._add_switch("Rig axes", "/axes")
            self._add_switch("Cloud", "/cloud")
            self._add_switch("Distance to the scan", "/judged")
            size = gui.add_slider("Point size", 0.1, 5.0, 0.1, 1.0)
            cloud, one = self.nodes["/cloud"], 0.02 * self.size
            size.on_update(lambda _: setattr(cloud, "point_size", one * size.value))
            for splat in scene.splats:
                self._add_switch(f"Splat {splat.name}", f"/splat/{splat.name}")
        gui.main_panel.dock_right()
        panel.dock_below(gui.main_panel)

    def _add_switch(self, label: str, name: str) -> None:
        """Add a checkbox that shows and hides a node, if the node exists."""
        if name in ("/frame", "/seen"):  # made with the first frame
            visible = name == "/frame"
        elif name in self.nodes:
            visible = self.nodes[name].visible
        else:
            return
        box = self.server.gui.add_checkbox(label, visible)
        box.on_update(lambda _: setattr(self.nodes[name], "visible", box.value))
        self.controls[label] = box

    def _place_face(self, f: int, view: Face, image: np.ndarray | None) -> None:
        """Place the image of a view at its pose; remove it if `image` is None."""
        name, axes = view.name, self.scene.optics.lenses.axes
        if image is None:
            if name in self._faces:
                self._faces.pop(name).remove()
            return
        turn = np.eye(3) if axes is None else axes[f]
        wxyz = quaternion_from_rotation(turn @ view.rig_R_view)
        position = self.scale * turn @ view.centre
        if name in self._faces:
            shown = self._faces[name]
            shown.image, shown.wxyz, shown.position = image, wxyz, position
            return
        wide, tall = view.width / (2 * view.focal), view.height / (2 * view.focal)
        self._faces[name] = self.server.scene.add_camera_frustum(
            f"/frame/{name}",
            2 * np.arctan(tall),
            wide / tall,
            scale=0.5 * self.size * np.cbrt(wide * tall),  # one distance from the lens for all
            thickness=0.006 * self.size,
            color=_AFTER,
            image=image,
            format="jpeg",
            jpeg_quality=85,
            wxyz=wxyz,
            position=position,
            cast_shadow=False,
            receive_shadow=False,
        )

    def _about(self, f: int, problem: str) -> str:
        scene, quality = self.scene, self._quality
        status = PoseStatus(scene.reconstruction.pose_statuses[f]).name.lower()
        time = scene.frames.timestamps[f]
        rows = [f"**{scene.frames.names[f]}** · {time:.3f} s · {status}"]
        residual = quality.median_residuals_deg[f]
        if np.isfinite(residual):
            rows.append(
                f"{quality.num_observations[f]} observations, median residual {residual:.4f}°"
            )
        if scene.coarse_T_rigs is not None:
            shift = scene.reconstruction.world_T_rigs[f, :3, 3] - scene.coarse_T_rigs[f, :3, 3]
            rows.append(f"moved {np.linalg.norm(shift):.3g} {scene.unit} by the refinement")
        return "\n\n".join([*rows, *([f"No image: {problem}"] if problem else [])])

    def _select(self, f: int | None) -> None:
        if f is not None:
            self.controls["Number"].value = int(f)  # its callback shows the frame

    def _outside(self) -> tuple[np.ndarray, np.ndarray]:
        """Camera position from which the whole path is visible, and the middle of the path."""
        positions = self.scale * self.scene.reconstruction.world_T_rigs[:, :3, 3]
        centre = (positions.min(axis=0) + positions.max(axis=0)) / 2
        extent = max(extent_of(positions), 2 * self.size)
        up = self.scene.up
        level = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        level /= np.linalg.norm(level)
        return centre + extent * (0.7 * up + 0.7 * level), centre

    def _stand(self, client: "viser.ClientHandle | None", inside: bool) -> None:
        """Move a browser's camera to the shown frame, to look ahead, or to see the whole run."""
        if client is None:
            return
        position, target = self._outside()
        if inside:
            world_T_rig = self.scene.reconstruction.world_T_rigs[self.frame]
            position = self.scale * world_T_rig[:3, 3]
            target = position + 0.05 * self.size * world_T_rig[:3, 2]
        with client.atomic():
            client.camera.position = position
            client.camera.look_at = target


def _pyramid(length: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (5, 3) and triangles (4, 3) of a pyramid along z without a base."""
    half = 0.6 * length
    corners = [[-half, -half, length], [half, -half, length], [half, half, length]]
    vertices = np.array([[0, 0, 0], *corners, [-half, half, length]], np.float32)
    sides = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4]]
    return vertices, np.array(sides, np.uint32)
