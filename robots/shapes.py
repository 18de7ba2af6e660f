"""Reader of the visible shapes of a URDF's links: boxes, cylinders, spheres and meshes with their colours."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robots import meshes
from robots.errors import RobotError
from robots.rotations import Float64
from robots.urdf import document, numbers, origin_of, text_of

Colour = tuple[float, float, float, float]
KINDS = ("box", "cylinder", "sphere", "mesh")
PLAIN: Colour = (0.7, 0.7, 0.7, 1.0)  # colour of a shape without a material


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Shape of a link: box (x, y, z), cylinder (radius, length along z) or sphere (radius,) in m, or a mesh.

    A mesh is the content of `file`, scaled by `size` (x, y, z); other shapes have no file. `origin` [4, 4] is the pose
    of its centre (a mesh's origin) in the link; `colour` is red, green, blue, opacity, 0 to 1, for a mesh too.
    """

    link: str
    kind: str
    size: tuple[float, ...]
    origin: Float64
    colour: Colour
    file: Path | None = None

    def bounds(self) -> tuple[Float64, Float64]:
        """Return the lower and upper corner [3] of the box around the shape [m].

        The box is in the shape's own frame, i.e. `origin` is not applied yet.
        """
        return shape_bounds(self.kind, self.size, self.file)

    def box_corners(self) -> Float64:
        """Return the corners [8, 3] of the shape's box in its own frame [m], before `origin`."""
        ends = np.array(self.bounds())  # [2, 3]
        return np.array([[ends[i, 0], ends[j, 1], ends[k, 2]] for i, j, k in np.ndindex(2, 2, 2)])


def shape_bounds(kind: str, size: tuple[float, ...], file: Path | None) -> tuple[Float64, Float64]:
    """Return the corners [3] of the box around a shape in its own frame [m].

    Raises:
        RobotError: If a mesh cannot be read.
    """
    if kind == "mesh":
        assert file is not None  # a mesh always has a file
        corners = np.array(meshes.mesh_bounds(file)) * size
        return corners.min(axis=0), corners.max(axis=0)
    if kind == "box":
        half = np.array(size) / 2
    else:
        radius = size[0]
        half = np.array([radius, radius, size[1] / 2 if kind == "cylinder" else radius])
    return -half, half


def read_shapes(path: Path) -> tuple[Shape, ...]:
    """Return the shapes in the file's order.

    The result depends on the environment only for links with meshes, which may be in $EVA_ROBOT_MESHES.

    Raises:
        RobotError: If a shape is invalid; the message names file, link and fault.
    """
    return _read(path, everywhere=False)


def displayed_shapes(path: Path) -> tuple[Shape, ...]:
    """Return the shapes for drawing.

    A link with a mesh of its name under $EVA_ROBOT_MESHES is shown as that mesh.
    """
    return _read(path, everywhere=True)


def _read(path: Path, *, everywhere: bool) -> tuple[Shape, ...]:
    robot = document(path)
    materials = {
        text_of(path, element, "name"): colour_of(path, f"material {element.get('name')!r}", colour)
        for element in robot.iter("material")  # a material declared in a visual can be used by name elsewhere
        if element.get("name") and (colour := element.find("color")) is not None
    }
    return tuple(
        shape
        for link in robot.findall("link")
        for shape in _shapes(
            path, link, materials, everywhere or link.find("visual/geometry/mesh") is not None
        )
    )


def _shapes(
    path: Path, link: ET.Element, materials: Mapping[str, Colour], replaceable: bool
) -> Iterator[Shape]:
    name = text_of(path, link, "name")
    visuals = link.findall("visual")
    file = meshes.replacement_mesh(path.parent, name) if replaceable else None
    if file is None:
        yield from (_shape(path, name, visual, materials) for visual in visuals)
    else:
        colour = _material(path, f"link {name!r}", visuals[0], materials) if visuals else PLAIN
        yield Shape(name, "mesh", (1.0, 1.0, 1.0), np.eye(4), colour, file)


def _shape(path: Path, link: str, visual: ET.Element, materials: Mapping[str, Colour]) -> Shape:
    owner = f"link {link!r}"
    geometry = visual.find("geometry")
    elements = [] if geometry is None else list(geometry)
    if len(elements) != 1 or elements[0].tag not in KINDS:
        tags = ", ".join(f"<{element.tag}>" for element in elements) or "nothing"
        raise RobotError(f"{path}: {owner}: a visual shows {tags}; allowed: one of {', '.join(KINDS)}")
    element = elements[0]
    size = size_of(path, owner, element)
    file = None
    if element.tag == "mesh":
        file = meshes.resolve_mesh(path.parent, f"{path}: {owner}", text_of(path, element, "filename"))
    colour = _material(path, owner, visual, materials)
    return Shape(link, element.tag, size, origin_of(path, owner, visual), colour, file)


def size_of(path: Path, owner: str, element: ET.Element) -> tuple[float, ...]:
    """Return the lengths of a shape [m]; for a mesh the scale factors (default 1; negative values mirror)."""
    if element.tag == "mesh":
        text = element.get("scale", "1 1 1")
        scale = numbers(path, owner, "mesh scale", text, 3)
        if 0 in scale:
            raise RobotError(f"{path}: {owner}: mesh scale {text}; allowed: factors other than zero")
        return tuple(scale)
    keys = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}[element.tag]
    count = 3 if element.tag == "box" else 1
    texts = [text_of(path, element, key) for key in keys]
    size = tuple(
        number
        for key, text in zip(keys, texts, strict=True)
        for number in numbers(path, owner, f"{element.tag} {key}", text, count)
    )
    if min(size) <= 0:
        raise RobotError(f"{path}: {owner}: {element.tag} {' '.join(texts)}; allowed: lengths above zero")
    return size


def _material(path: Path, owner: str, visual: ET.Element, materials: Mapping[str, Colour]) -> Colour:
    material = visual.find("material")
    if material is None:
        return PLAIN
    colour = material.find("color")
    if colour is not None:
        return colour_of(path, owner, colour)
    name = text_of(path, material, "name")
    if name not in materials:
        allowed = ", ".join(materials) or "none is declared"
        raise RobotError(f"{path}: {owner}: material {name!r} is not declared; allowed: {allowed}")
    return materials[name]


def colour_of(path: Path, owner: str, element: ET.Element) -> Colour:
    """Return the four numbers of a <color> element.

    Raises:
        RobotError: If they are not four numbers from 0 to 1.
    """
    red, green, blue, opacity = numbers(path, owner, "color rgba", text_of(path, element, "rgba"), 4)
    colour = (red, green, blue, opacity)
    if not all(0 <= part <= 1 for part in colour):
        raise RobotError(f"{path}: {owner}: color rgba is {colour}; allowed: 0 to 1 each")
    return colour
