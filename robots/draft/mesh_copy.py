"""Copy of a URDF with its visuals and meshes into a robot's folder.

Shapes that cannot be shown are replaced by simple stand-ins.
"""

from __future__ import annotations

import itertools
import math
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from robots import meshes, shapes
from robots.errors import RobotError
from robots.rotations import Float64
from robots.urdf import Joint, Urdf, parsed

_MESHES = "meshes"
_STICK, _THICKEST, _THINNEST = (
    0.15,
    0.04,
    0.012,
)  # radius of a stand-in: share of its length, greatest [m], smallest [m]
_SHORTEST = 0.02  # [m] distance of two joints from which there is a stand-in
_KNOB = 0.015  # [m] radius of the stand-in for the end of a chain
_COLOUR = "0.55 0.58 0.63 1"


@dataclass(frozen=True, slots=True)
class MeshCopyReport:
    """Report on the shapes: `copied` files, and `missing` meshes that were not found or are unreadable.

    `drawn` are links shown by stand-ins; `plain` are links whose material was not declared, or has no valid colour.
    """

    copied: tuple[str, ...]
    missing: tuple[str, ...]
    drawn: tuple[str, ...]
    plain: tuple[str, ...]


def copy_urdf(tree: Urdf, target: Path) -> MeshCopyReport:
    """Write the URDF to `target`, and its meshes to the folder meshes/ next to it.

    If everything can be shown, the URDF is copied unchanged. Otherwise visuals of missing meshes are replaced by
    cylinders from joint to joint. If nothing can be shown, all links get such cylinders.
    """
    robot = parsed(tree.path, comments=True)
    work = _UrdfCopy(tree, target, robot)
    work.colours()
    work.meshes()
    work.stand_ins()
    work.materials()
    if work.changed:
        document = ET.ElementTree(robot)
        ET.indent(document)
        document.write(target, encoding="utf-8", xml_declaration=True)
    else:
        shutil.copyfile(tree.path, target)
    shapes.read_shapes(target)  # refuse here what still cannot be shown, instead of when drawing
    return MeshCopyReport(tuple(work.copied), tuple(work.missing), tuple(work.drawn), tuple(work.plain))


class _UrdfCopy:
    def __init__(self, tree: Urdf, target: Path, robot: ET.Element) -> None:
        self._tree = tree
        self._target = target
        self._robot = robot
        self._taken: dict[str, Path] = {}
        self._bare: list[ET.Element] = []
        self.copied: list[str] = []
        self.missing: list[str] = []
        self.drawn: list[str] = []
        self.plain: list[str] = []
        self._recoloured = False

    @property
    def changed(self) -> bool:
        return bool(self.copied or self.drawn or self.plain or self._bare or self._recoloured)

    def meshes(self) -> None:
        """Copy readable meshes and let visuals refer to the copies; remove visuals that cannot be shown."""
        for link in self._robot.findall("link"):
            for visual in link.findall("visual"):
                geometry = visual.find("geometry")
                mesh = None if geometry is None else geometry.find("mesh")
                if mesh is not None and self._sized(mesh) and self._copied(mesh):
                    continue
                elements = [] if geometry is None or mesh is not None else list(geometry)
                if len(elements) == 1 and elements[0].tag in shapes.KINDS and self._sized(elements[0]):
                    continue
                link.remove(visual)
                if link not in self._bare:
                    self._bare.append(link)

    def _sized(self, shape: ET.Element) -> bool:
        """Return True if the shape has valid sizes: lengths above zero, or for a mesh factors that are not zero."""
        try:
            shapes.size_of(self._tree.path, "a visual", shape)
        except RobotError:
            return False
        return True

    def colours(self) -> None:
        """Remove colours that are not four numbers from 0 to 1."""
        for link in self._robot.findall("link"):
            for material in link.iter("material"):
                if self._without_odd_colour(material):
                    self._show_plain(link)
        for material in self._robot.findall("material"):
            self._recoloured |= self._without_odd_colour(material)

    def _without_odd_colour(self, material: ET.Element) -> bool:
        colour = material.find("color")
        if colour is None:
            return False
        try:
            shapes.colour_of(self._tree.path, "a material", colour)
        except RobotError:
            material.remove(colour)
            return True
        return False

    def _show_plain(self, link: ET.Element) -> None:
        """Record that the link is shown in the plain colour."""
        name = link.get("name", "")
        self.plain += [name] if name not in self.plain else []

    def stand_ins(self) -> None:
        """Add cylinders to links that lost all visuals; if no link has a visual left, add them to all links."""
        links = self._robot.findall("link")
        if not any(link.find("visual") is not None for link in links):
            self._bare = links
        for link in self._bare:
            if link.find("visual") is None:
                sticks = list(self._sticks(link.get("name", "")))
                link.extend(sticks)
                self.drawn += [link.get("name", "")] if sticks else []

    def materials(self) -> None:
        """Remove references to undeclared materials; such shapes get the plain colour."""
        declared = {
            material.get("name")
            for material in self._robot.iter("material")
            if material.find("color") is not None
        }
        for link in self._robot.findall("link"):
            for visual in link.findall("visual"):
                material = visual.find("material")
                if material is None or material.find("color") is not None:
                    continue
                if not material.get("name") or material.get("name") not in declared:
                    visual.remove(material)
                    self._show_plain(link)

    def _copied(self, mesh: ET.Element) -> bool:
        named = mesh.get("filename", "")
        file = next((place for place in _places(self._tree.path, named) if _readable(place)), None)
        if file is None:
            self.missing += [named] if named not in self.missing else []
            return False
        name = next(name for name in _names(file) if self._taken.setdefault(name, file) == file)
        folder = self._target.parent / _MESHES
        folder.mkdir(exist_ok=True)
        shutil.copyfile(file, folder / name)
        mesh.set("filename", f"{_MESHES}/{name}")
        self.copied += [name] if name not in self.copied else []
        return True

    def _sticks(self, link: str) -> Iterator[ET.Element]:
        """Yield cylinders from the link's origin to each of its joints, or a sphere if the chain ends with the link."""
        above = self._tree.above(link)
        offsets = [joint.origin[:3, 3] for joint in self._tree.children(link) if not self._is_frame(joint)]
        long = [offset for offset in offsets if np.linalg.norm(offset) >= _SHORTEST]
        if not long and above is not None and above.kind != "fixed":
            yield _visual(np.zeros(3), "0 0 0", ET.Element("sphere", radius=f"{_KNOB:g}"))
        for offset in long:
            length = float(np.linalg.norm(offset))
            radius = min(max(_STICK * length, _THINNEST), _THICKEST)
            pitch, yaw = math.acos(offset[2] / length), math.atan2(offset[1], offset[0])
            stick = ET.Element("cylinder", radius=f"{radius:.4f}", length=f"{length:.4f}")
            yield _visual(offset / 2, f"0 {pitch:.6f} {yaw:.6f}", stick)

    def _is_frame(self, joint: Joint) -> bool:
        """Return True if the joint leads to a link that is only a frame, such as the frame between fingertips."""
        link = next(link for link in self._robot.findall("link") if link.get("name") == joint.child)
        return joint.kind == "fixed" and not self._tree.children(joint.child) and link.find("visual") is None


def _visual(centre: Float64, rpy: str, shape: ET.Element) -> ET.Element:
    visual = ET.Element("visual")
    ET.SubElement(visual, "origin", xyz=" ".join(f"{value:.6f}" for value in centre), rpy=rpy)
    ET.SubElement(visual, "geometry").append(shape)
    material = ET.SubElement(visual, "material", name="stand_in")
    ET.SubElement(material, "color", rgba=_COLOUR)
    return visual


def _names(file: Path) -> Iterator[str]:
    """Yield file names for a copy, from which the caller uses the first that is free."""
    yield file.name
    yield f"{file.parent.name}_{file.name}"
    for number in itertools.count(2):
        yield f"{file.parent.name}_{number}_{file.name}"


def _places(source: Path, named: str) -> Iterator[Path]:
    """Yield the paths at which a mesh of the URDF `source` may be, whose name in the URDF is `named`.

    A name without a scheme is relative to the folder of the URDF, and a file URL is a path. In a package URL, the
    package may be a folder that contains the URDF, or a folder in one of these. The rest of the URL may also be
    relative to the folder of the URDF.
    """
    scheme, separator, path = named.partition("://")
    folder = source.resolve().parent
    if not separator:
        yield folder / named
    elif scheme == "file":
        yield Path(unquote(path))
    elif scheme in ("package", "model"):
        package, _, inside = path.partition("/")
        for above in (folder, *folder.parents):
            if above.name == package:
                yield above / inside
            yield above / package / inside
        yield folder / inside


def _readable(place: Path) -> bool:
    if not place.is_file() or place.suffix.lower() not in meshes.SUFFIXES:
        return False
    try:
        meshes.mesh_bounds(place)
    except RobotError:
        return False
    return True
