"""Quantiles are those of numpy."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.quantiles import quantiles

FRACTIONS = (0.0, 0.5, 0.99, 0.999, 1.0)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=300))
def test_they_are_those_of_numpy(figures: list[float]) -> None:
    given_ = np.array(figures)
    assert np.allclose(quantiles(given_, FRACTIONS), np.quantile(given_, FRACTIONS), rtol=1e-12, atol=1e-9)
