"""Masses and inertias of a URDF's links, if it declares them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robots.errors import RobotError
from robots.rotations import Float64
from robots.urdf import document, numbers, origin_of, text_of


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """Mass [kg], centre of mass [3] and inertia [3, 3] about it, in the axes of a link [m, kg m2]."""

    mass: float
    centre: Float64
    inertia: Float64


def read_inertials(path: Path) -> dict[str, Inertial]:
    """Return the inertials by link; links without one, or with the mass 0, have none.

    Raises:
        RobotError: If an inertial is incomplete or not physical; the message names file, link and fault.
    """
    found = {}
    for link in document(path).findall("link"):
        element, name = link.find("inertial"), text_of(path, link, "name")
        inertial = None if element is None else _inertial(path, f"link {name!r}", element)
        if inertial is not None and inertial.mass > 0:
            found[name] = inertial
    return found


def combine(parts: Sequence[tuple[Float64, Inertial]]) -> Inertial:
    """Return the inertial of one or more links that are rigidly connected; each has its pose [4, 4] in a common frame.

    Inertias are moved to the common centre by the parallel axis theorem.
    """
    mass = sum(inertial.mass for _, inertial in parts)
    centres = [pose[:3, :3] @ inertial.centre + pose[:3, 3] for pose, inertial in parts]
    weighted = [inertial.mass * centre for (_, inertial), centre in zip(parts, centres, strict=True)]
    centre = np.asarray(np.sum(weighted, axis=0) / mass)
    total = np.zeros((3, 3))
    for (pose, inertial), own in zip(parts, centres, strict=True):
        offset = own - centre
        shift = inertial.mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        total += pose[:3, :3] @ inertial.inertia @ pose[:3, :3].T + shift
    return Inertial(mass, centre, total)


def _inertial(path: Path, owner: str, element: ET.Element) -> Inertial:
    mass = _value(path, owner, element.find("mass"), "mass", "value")
    tensor = element.find("inertia")
    xx, xy, xz, yy, yz, zz = (
        _value(path, owner, tensor, "inertia", key) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if mass < 0 or np.linalg.eigvalsh(inertia).min() < 0:
        raise RobotError(f"{path}: {owner}: an inertial has a negative mass or principal inertia")
    origin = origin_of(path, owner, element)
    return Inertial(mass, origin[:3, 3], origin[:3, :3] @ inertia @ origin[:3, :3].T)


def _value(path: Path, owner: str, element: ET.Element | None, tag: str, key: str) -> float:
    text = None if element is None else element.get(key)
    if text is None:
        raise RobotError(f"{path}: {owner}: an inertial has no {key!r} in <{tag}>")
    return numbers(path, owner, f"{tag} {key}", text, 1)[0]
