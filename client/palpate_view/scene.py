"""What is seen of a model: the organ, colors on it, the tool and its ghost, points in contact, the force.

The page shows 1 dm as one unit, for which viser's lights and camera are made; a position in the model times SCENE_PER_M is one in
the scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from palpate_view import colors
from palpate_view.surface import Floats, Triangles, bands, vertex_normals

SCENE_PER_M = 10.0
_ARROW_LENGTH = 0.35  # of the organ's size, for a newton
_LONGEST_ARROW = 0.9  # of the organ's size
_SMALLEST_FORCE_N = 0.01
_STILL_M = 2e-5  # displacements that change by less look the same
_GHOST_GAP_M = 2e-4  # a ghost that is nearer to the tool is not shown
_ROUND = 5  # subdivisions of a sphere
_SHAFT = 0.4  # of the organ's size
_LIFT = 4e-4  # of the organ's size: so far the colors are above the tissue
_UP = np.array([0.0, 0.0, 1.0])
_DECIMALS = (
    4  # of positions in the scene, 10 um: what moves by less is not sent, and the page need not draw it
)

Drag = Callable[[Any], Any]  # an async function that takes viser's SceneNodeDragEvent


class Scene:
    """The nodes of one model.

    vertices (n, 3), m, at rest; normals (n, 3) there; triangles (m, 3); size_m: of the organ, its bounding box's diagonal.
    """

    def __init__(self, api: viser.SceneApi, vertices: Floats, triangles: Triangles) -> None:
        self.vertices, self.triangles = vertices, triangles
        self.normals = vertex_normals(vertices, triangles)
        self.size_m = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        self.center_m = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        self._lift = _LIFT * self.size_m * self.normals
        size = SCENE_PER_M * self.size_m
        self._organ = api.add_mesh_simple(
            "/organ", SCENE_PER_M * vertices, triangles, color=colors.TISSUE, side="double"
        )
        nothing, no_face = np.zeros((3, 3)), np.array([[0, 1, 2]])
        self._bands = [
            api.add_mesh_simple(f"/bands/{i}", nothing, no_face, color=color, side="double", visible=False)
            for i, color in enumerate(colors.band_colors())
        ]
        self._tool = api.add_icosphere("/tool", 1.0, colors.STEEL, subdivisions=_ROUND)
        self._shaft = api.add_cylinder("/shaft", 0.28, 1.0, colors.STEEL)
        self._ghost = api.add_icosphere("/ghost", 1.0, colors.GHOST, opacity=0.35, subdivisions=_ROUND)
        self._contact = api.add_point_cloud(
            "/contact", np.zeros((1, 3)), colors.CONTACT, point_size=0.008 * size, point_shape="circle",
            point_shading="gradient", precision="float32",
        )  # fmt: skip
        self._force = api.add_arrows(
            "/force", np.zeros((1, 2, 3)), colors.FORCE,
            shaft_radius=0.007 * size, head_radius=0.018 * size, head_length=0.045 * size,
        )  # fmt: skip
        self._label = api.add_label("/force_label", "", anchor="bottom-center", font_screen_scale=1.3)
        for node in (self._ghost, self._contact, self._force, self._label):
            node.visible = False
        self.shown_m = vertices  # (n, 3), m: where the vertices are seen
        self._drawn = np.full_like(vertices, np.nan, np.float32)  # the displacement that is seen
        self._drawn_scale: tuple[str, float] | None = None

    def on_drag(self, organ: Drag, tool: Drag) -> None:
        """Call organ(event) and tool(event) for each of viser's drag events on them."""
        self._organ.on_drag("left")(organ)
        for node in (self._tool, self._shaft):
            node.on_drag("left")(tool)

    def draw_organ(self, displacement: NDArray[np.float32], coloring: colors.Coloring | None) -> None:
        """The organ with a displacement (n, 3), m, and colors on it, or none.

        Nothing is sent while nothing is seen to move.
        """
        scale = None if coloring is None else (coloring.name, coloring.largest)
        if scale == self._drawn_scale and np.abs(displacement - self._drawn).max() < _STILL_M:
            return
        self._drawn, self._drawn_scale = displacement.copy(), scale
        self.shown_m = self.vertices + displacement
        self._organ.vertices = (SCENE_PER_M * self.shown_m).astype(np.float32)
        if coloring is None:
            for node in self._bands:
                node.visible = False
            return
        levels = colors.band_levels(coloring.largest)
        found = bands(self.shown_m + self._lift, self.triangles, coloring.values, levels)
        for node, (points, faces) in zip(self._bands, found, strict=True):
            if len(faces):
                node.vertices, node.faces = SCENE_PER_M * points, faces
            node.visible = bool(len(faces))

    def draw_tool(self, center_m: Floats, ghost_m: Floats, radius_m: float, axis: Floats) -> None:
        """The tool, its shaft along `axis` (3,), and its ghost where the device is, if that is elsewhere."""
        self._tool.radius = self._ghost.radius = SCENE_PER_M * radius_m
        self._tool.position = in_scene(center_m)
        length_m = _SHAFT * self.size_m
        self._shaft.radius, self._shaft.height = SCENE_PER_M * 0.28 * radius_m, SCENE_PER_M * length_m
        self._shaft.position = in_scene(center_m + 0.5 * length_m * axis)
        self._shaft.wxyz = np.array(rotation_to(axis)).round(_DECIMALS)
        self._ghost.visible = float(np.linalg.norm(ghost_m - center_m)) > _GHOST_GAP_M
        self._ghost.position = in_scene(ghost_m)

    def draw_contact(self, points_m: Floats, center_m: Floats, force_n: Floats) -> None:
        """The points in contact (k, 3), m, and the force on the tool as an arrow from its center, with its magnitude."""
        self._contact.visible = bool(len(points_m))
        if len(points_m):
            self._contact.points = in_scene(points_m).astype(np.float32)
        force_n = force_n.round(2)  # as the label shows it
        newtons = float(np.linalg.norm(force_n))
        self._force.visible = self._label.visible = newtons > _SMALLEST_FORCE_N
        if newtons > _SMALLEST_FORCE_N:
            end = center_m + arrow(force_n, self.size_m)
            self._force.points = in_scene(np.array([[center_m, end]])).astype(np.float32)
            self._label.position = in_scene(end)
            self._label.text = f"{newtons:.2f} N"


def in_scene(points_m: Floats) -> Floats:
    """Points of the model, m, where the scene has them."""
    return (SCENE_PER_M * points_m).round(_DECIMALS)


def arrow(force_n: Floats, size_m: float) -> Floats:
    """(3,), m: the arrow of a force (3,), N; its length grows with the force, up to a bound."""
    newtons = float(np.linalg.norm(force_n))
    length_m = size_m * min(_ARROW_LENGTH * newtons, _LONGEST_ARROW)
    return force_n * (length_m / newtons)


def rotation_to(axis: Floats) -> tuple[float, float, float, float]:
    """The quaternion w, x, y, z that turns the z axis to a unit vector (3,)."""
    x, y, z = (float(c) for c in axis)
    if z < -1 + 1e-9:
        return 0.0, 1.0, 0.0, 0.0
    w = math.sqrt((1 + z) / 2)
    return w, -y / (2 * w), x / (2 * w), 0.0


def view_from(normal: Floats) -> Floats:
    """(3,), of length 1: obliquely before a tool with a normal (3,), and from above."""
    level = normal - (normal @ _UP) * _UP
    if np.linalg.norm(level) < 0.3:  # the tool comes from above or from below
        level = np.array([0.0, -1.0, 0.0])
    level /= np.linalg.norm(level)
    direction = 0.80 * level + 0.40 * np.cross(_UP, level) + 0.55 * _UP
    return direction / float(np.linalg.norm(direction))


def camera_position(center_m: Floats, size_m: float, normal: Floats, aspect: float, fov_rad: float) -> Floats:
    """(3,), m: from where the organ fills the picture, along `view_from`.

    aspect: width over height; fov_rad: vertical field of view.
    """
    half = math.atan(math.tan(fov_rad / 2) * min(1.0, aspect))
    return center_m + view_from(normal) * (0.54 * size_m / math.sin(half))


def light(api: viser.SceneApi, normal: Floats) -> None:
    """Light from the camera's left, a weaker one from its right, and one from behind that draws the outline. No shadows.

    Shadows and pictures of surroundings would cost a phone more than all the rest.
    """
    api.configure_default_lights(False)
    api.configure_environment_map(None)
    front = view_from(normal)
    right = np.cross(_UP, front)
    right /= np.linalg.norm(right)
    api.add_light_hemisphere(
        "/light/sky", sky_color=(205, 220, 255), ground_color=(110, 85, 80), intensity=1.0
    )
    for name, direction, color, intensity in (
        ("key", front - 0.9 * right + 0.9 * _UP, (255, 244, 232), 2.3),
        ("fill", front + 1.2 * right + 0.1 * _UP, (200, 215, 255), 0.7),
        ("rim", -front + 0.3 * right + 0.8 * _UP, (255, 255, 255), 1.6),
    ):
        api.add_light_directional(
            f"/light/{name}", color=color, intensity=intensity, position=tuple(30.0 * direction)
        )


def background() -> NDArray[np.uint8]:
    """(256, 4, 3): a picture that gets lighter from the bottom upwards."""
    shade = np.linspace(1.0, 0.0, 256)[:, None, None]
    bottom, top = np.array([14.0, 17.0, 22.0]), np.array([46.0, 55.0, 68.0])
    return np.broadcast_to(bottom + shade * (top - bottom), (256, 4, 3)).astype(np.uint8)
