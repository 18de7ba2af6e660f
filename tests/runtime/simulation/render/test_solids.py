from __future__ import annotations

import itertools

import numpy as np
import pytest

from runtime.simulation.render.solids import Solid, Solids

TURNED = np.array([[0, -1, 0, 0.5], [1, 0, 0, -0.25], [0, 0, 1, 2], [0, 0, 0, 1.0]])


def solid(kind: str, *size: float, frame: int = 0, origin: np.ndarray | None = None) -> Solid:
    return Solid(frame, kind, size, np.eye(4) if origin is None else origin, (0.5, 0.5, 0.5))


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        (solid("box", 0.2, 0.3, 0.4), 0.024),
        (solid("cylinder", 0.1, 0.02, origin=TURNED), np.pi * 0.1**2 * 0.02),
        (solid("cylinder", 0.1, 0.5), np.pi * 0.1**2 * 0.5),
        (solid("sphere", 0.2, origin=TURNED), 4 / 3 * np.pi * 0.2**3),
    ],
)
def test_faces_enclose_the_volume_and_look_outwards(shape: Solid, volume: float) -> None:
    solids = Solids([shape])
    placed = solids.placed(np.eye(4)[None])
    centre = shape.origin[:3, 3]
    enclosed = 0.0
    for face, normal in zip(solids.faces, placed.normals, strict=True):
        corners = placed.vertices[face].astype(np.float64)
        np.testing.assert_allclose((corners - corners[0]) @ normal, 0, atol=1e-6)
        assert (corners[0] - centre) @ normal > 0
        fan = [np.cross(b - corners[0], c - corners[0]) for b, c in itertools.pairwise(corners)]
        enclosed += (corners[0] - centre) @ np.sum(fan, axis=0) / 6
    assert 0.85 * volume < enclosed <= volume * 1.0001


def test_solids_move_with_their_frames_and_their_boxes_with_them() -> None:
    solids = Solids([solid("box", 0.2, 0.4, 0.6, frame=1), solid("cylinder", 0.1, 0.8, origin=TURNED)])
    frames = np.stack([np.eye(4), TURNED])
    placed = solids.placed(frames)
    first = placed.vertices[solids.starts[0] : solids.stops[0]]
    np.testing.assert_allclose(first.min(0), [0.5 - 0.2, -0.25 - 0.1, 2 - 0.3], atol=1e-6)
    np.testing.assert_allclose(first.max(0), [0.5 + 0.2, -0.25 + 0.1, 2 + 0.3], atol=1e-6)
    np.testing.assert_allclose(placed.centres, [TURNED[:3, 3]] * 2, atol=1e-6)
    np.testing.assert_allclose(solids.halves, [[0.1, 0.2, 0.3], [0.1, 0.1, 0.4]], atol=1e-6)
    np.testing.assert_allclose(placed.axes[0], TURNED[:3, :3].T, atol=1e-6)


def test_what_stands_in_the_table_ends_at_its_surface_and_what_is_under_it_is_not_seen() -> None:
    def box(z: float) -> Solid:
        place = np.eye(4)
        place[2, 3] = z
        return Solid(0, "box", (0.2, 0.2, 0.2), place, (1.0, 1.0, 1.0))

    solids = Solids([box(0.05), box(-0.3), box(0.5)])
    whole = solids.placed(np.eye(4)[None])
    cut = solids.above_table(whole)
    assert whole.seen.all()
    assert whole.vertices[:, 2].min() == pytest.approx(-0.4)
    assert cut.seen.tolist() == [True, False, True]
    assert cut.vertices[:8, 2].min() == 0.0
    np.testing.assert_array_equal(cut.vertices[16:], whole.vertices[16:])
