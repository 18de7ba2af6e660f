from __future__ import annotations

import itertools

import numpy as np
import pytest

from runtime.simulation.bench.bench import Bench
from runtime.simulation.render.solids import Solid, Solids, disc_solid, shape_solid

TURNED = np.array([[0, -1, 0, 0.5], [1, 0, 0, -0.25], [0, 0, 1, 2], [0, 0, 0, 1.0]])
PLATE = Bench().discs[0]


def shape(kind: str, *size: float, frame: int = 0, origin: np.ndarray | None = None) -> Solid:
    return shape_solid(frame, kind, size, np.eye(4) if origin is None else origin, (0.5, 0.5, 0.5))


def faces(solids: Solids, vertices: np.ndarray) -> list[np.ndarray]:
    """The corners of each face."""
    return [vertices[face] for face in np.split(solids.geometry.corners, solids.geometry.face_starts[1:-1])]


@pytest.mark.parametrize(
    ("solid", "volume"),
    [
        (shape("box", 0.2, 0.3, 0.4), 0.024),
        (shape("cylinder", 0.1, 0.02, origin=TURNED), np.pi * 0.1**2 * 0.02),
        (shape("cylinder", 0.1, 0.5), np.pi * 0.1**2 * 0.5),
        (shape("sphere", 0.2, origin=TURNED), 4 / 3 * np.pi * 0.2**3),
    ],
)
def test_faces_enclose_the_volume_and_look_outwards(solid: Solid, volume: float) -> None:
    solids = Solids([solid])
    vertices, normals = solids.placed(np.eye(4)[None])
    centre = vertices.mean(0)
    enclosed = 0.0
    for corners, normal in zip(faces(solids, vertices), normals, strict=True):
        np.testing.assert_allclose((corners - corners[0]) @ normal, 0, atol=1e-6)
        assert (corners[0] - centre) @ normal > 0
        fan = [np.cross(b - corners[0], c - corners[0]) for b, c in itertools.pairwise(corners)]
        enclosed += (corners[0] - centre) @ np.sum(fan, axis=0) / 6
    assert 0.85 * volume < enclosed <= volume * 1.0001


def test_a_plate_is_seen_from_above_and_from_its_side_and_has_a_slope_inside() -> None:
    solids = Solids([disc_solid(0, PLATE)])
    vertices, normals = solids.placed(np.eye(4)[None])
    for corners, normal in zip(faces(solids, vertices), normals, strict=True):
        np.testing.assert_allclose((corners - corners[0]) @ normal, 0, atol=1e-9)
        middle = corners.mean(0)
        radius = np.hypot(*middle[:2])
        outwards = normal[:2] @ middle[:2]
        assert (outwards > 0 and radius > 0.95 * PLATE.radius) or normal[2] > 0.3
    np.testing.assert_allclose(vertices[:, 2].max(), PLATE.height)
    np.testing.assert_allclose(vertices[-1, 2], 0.33 * PLATE.height)


def test_solids_move_with_their_frames() -> None:
    solids = Solids([shape("box", 0.2, 0.4, 0.6, frame=1), shape("cylinder", 0.1, 0.8, origin=TURNED)])
    vertices, normals = solids.placed(np.stack([np.eye(4), TURNED]))
    np.testing.assert_allclose(vertices[:8].min(0), [0.5 - 0.2, -0.25 - 0.1, 2 - 0.3], atol=1e-6)
    np.testing.assert_allclose(vertices[:8].max(0), [0.5 + 0.2, -0.25 + 0.1, 2 + 0.3], atol=1e-6)
    np.testing.assert_allclose(vertices[8:].mean(0), TURNED[:3, 3], atol=1e-6)
    np.testing.assert_allclose(normals[:6], solids.geometry.normals[:6] @ TURNED[:3, :3].T, atol=1e-6)
