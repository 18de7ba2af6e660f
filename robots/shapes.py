"""Reads the visible shapes of a URDF's links: boxes, cylinders and spheres with their colours."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from robots.errors import RobotError
from robots.rotations import Float64
from robots.urdf import document, numbers, origin_of, text_of

Colour = tuple[float, float, float, float]
KINDS = ("box", "cylinder", "sphere")
PLAIN: Colour = (0.7, 0.7, 0.7, 1.0)  # of a shape without a material


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """One shape of a link: box (x, y, z), cylinder (radius, length along z) or sphere (radius,) in m.

    `origin` [4, 4] places its centre in the link; `colour` is red, green, blue, opacity, 0 to 1.
    """

    link: str
    kind: str
    size: tuple[float, ...]
    origin: Float64
    colour: Colour


def read(path: Path) -> tuple[Shape, ...]:
    """The shapes in the file's order; RobotError names the file, the link and what is wrong with it."""
    robot = document(path)
    materials = {
        text_of(path, element, "name"): _colour(path, f"material {element.get('name')!r}", colour)
        for element in robot.findall("material")
        if (colour := element.find("color")) is not None
    }
    return tuple(
        _shape(path, text_of(path, link, "name"), visual, materials)
        for link in robot.findall("link")
        for visual in link.findall("visual")
    )


def _shape(path: Path, link: str, visual: ET.Element, materials: Mapping[str, Colour]) -> Shape:
    owner = f"link {link!r}"
    geometry = visual.find("geometry")
    given = [] if geometry is None else list(geometry)
    if len(given) != 1 or given[0].tag not in KINDS:
        tags = ", ".join(f"<{element.tag}>" for element in given) or "nothing"
        raise RobotError(f"{path}: {owner}: a visual shows {tags}; allowed: one of {', '.join(KINDS)}")
    size = _size(path, owner, given[0])
    colour = _material(path, owner, visual, materials)
    return Shape(link, given[0].tag, size, origin_of(path, owner, visual), colour)


def _size(path: Path, owner: str, element: ET.Element) -> tuple[float, ...]:
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
        return _colour(path, owner, colour)
    name = text_of(path, material, "name")
    if name not in materials:
        allowed = ", ".join(materials) or "none is declared"
        raise RobotError(f"{path}: {owner}: material {name!r} is not declared; allowed: {allowed}")
    return materials[name]


def _colour(path: Path, owner: str, element: ET.Element) -> Colour:
    red, green, blue, opacity = numbers(path, owner, "color rgba", text_of(path, element, "rgba"), 4)
    colour = (red, green, blue, opacity)
    if not all(0 <= part <= 1 for part in colour):
        raise RobotError(f"{path}: {owner}: color rgba is {colour}; allowed: 0 to 1 each")
    return colour
