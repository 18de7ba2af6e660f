"""How pages draw the objects of a simulated bench in 3D."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from runtime.benches.schema import BenchSchema


def describe_appearance(schema: BenchSchema) -> dict[str, Any]:
    """Return `blocks` (size, colour) and `discs` (radius, height, colour, rim) in the order of a bench's ground truth.

    Distractors, which are like the first block, follow the schema's blocks. Lengths in m, colours from 0 to 1.
    """
    boxes = list(schema.boxes.values())
    blocks = [(box.size, box.colour) for box in boxes]
    most = schema.factors["distractors"].high if "distractors" in schema.factors else 0
    blocks += [(boxes[0].size, schema.distractor_colour(number)) for number in range(round(most))]
    return {
        "blocks": [{"size": size, "colour": shade(colour)} for size, colour in blocks],
        "discs": [
            {
                "radius": disc.radius,
                "height": disc.height,
                "colour": shade(disc.colour),
                "rim": shade(disc.rim_colour),
            }
            for disc in schema.discs.values()
        ],
    }


def shade(parts: Sequence[int]) -> list[float]:
    """Return an opaque colour with parts from 0 to 1."""
    return [*(part / 255 for part in parts), 1.0]
