"""A blind plan with two checkpoints whose secrets are recognisable, and a station that publishes pictures."""

from __future__ import annotations

import numpy as np
import simplejpeg

SECRETS = {
    "pi0-secret-alder": {"url": "ws://host-alder.example:47611", "prompt_key": "option-alder"},
    "pi0-secret-birch": {"url": "ws://host-birch.example:47622", "prompt_key": "option-birch"},
}


def jpeg(seed: int = 0, noise: int = 0) -> bytes:
    """A picture of smooth blobs; another seed has others, noise makes it worse."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 255, (6, 8), np.uint8)
    picture = np.kron(small, np.ones((40, 40))).astype(np.int64)
    picture = picture + np.random.default_rng(99).integers(-noise, noise + 1, picture.shape)
    grey = np.clip(picture, 0, 255).astype(np.uint8)[..., None]
    return simplejpeg.encode_jpeg(np.ascontiguousarray(np.repeat(grey, 3, axis=2)), quality=85)
