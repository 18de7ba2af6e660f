from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from runtime.core.errors import RecordingError
from runtime.datasets.stats import aggregate_statistics, column_statistic, video_statistic
from tests.runtime.datasets.small import picture, write_video

ROWS = arrays(np.float32, st.tuples(st.integers(1, 9), st.just(3)), elements=st.floats(-100, 100, width=32))


@given(parts=st.lists(ROWS, min_size=1, max_size=5))
def test_statistics_of_parts_together_are_those_of_the_whole(parts: list[np.ndarray]) -> None:
    statistics = [{"x": statistic} for part in parts if (statistic := column_statistic(part))]
    together, whole = aggregate_statistics(statistics)["x"], column_statistic(np.concatenate(parts))
    assert whole is not None
    assert together["count"] == whole["count"]
    for name in ("min", "max", "mean", "std"):
        assert np.allclose(together[name], whole[name], rtol=1e-6, atol=1e-4)


def test_a_scalar_column_has_one_figure_each() -> None:
    assert column_statistic(np.array([1, 2, 6])) == {
        "min": [1],
        "max": [6],
        "mean": [3.0],
        "std": [pytest.approx(np.std([1, 2, 6]))],
        "count": [3],
        "q01": [pytest.approx(1.02)],
        "q10": [pytest.approx(1.2)],
        "q50": [2.0],
        "q90": [pytest.approx(5.2)],
        "q99": [pytest.approx(5.92)],
    }


def test_unknown_values_do_not_count() -> None:
    statistic = column_statistic(np.array([1.0, np.nan, 3.0]))
    assert statistic is not None
    assert (statistic["mean"], statistic["count"]) == ([2.0], [2])
    assert column_statistic(np.array([np.nan, np.nan])) is None


def test_flags_stay_flags() -> None:
    statistic = column_statistic(np.array([True, False, False, False]))
    assert statistic is not None
    assert (statistic["min"], statistic["max"], statistic["mean"]) == ([False], [True], [0.25])


def test_pictures_are_summed_up_by_channel_in_0_to_1(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 20, 30)
    statistic = video_statistic(tmp_path / "film.mp4", 20)
    grey = [float(picture(k)[0, 0, 0]) / 255 for k in range(20)]
    assert np.shape(statistic["mean"]) == (3, 1, 1)
    assert np.allclose(statistic["mean"], np.mean(grey), atol=0.01)
    assert np.allclose(statistic["std"], np.std(grey), atol=0.01)
    assert np.allclose(statistic["min"], min(grey), atol=0.02)
    assert np.allclose(statistic["max"], max(grey), atol=0.02)
    assert statistic["count"] == [20]


def test_a_long_video_is_sampled_evenly(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 45, 30, gop=10, b_frames=0)
    whole = video_statistic(tmp_path / "film.mp4", 45)
    from runtime.datasets import stats

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stats, "SAMPLED_PICTURES", 5)
        few = video_statistic(tmp_path / "film.mp4", 45)
    assert few["count"] == [5]
    assert np.allclose(few["mean"], whole["mean"], atol=0.02)


def test_another_number_of_frames_is_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 20, 30)
    with pytest.raises(RecordingError, match="20 frames, expected 21"):
        video_statistic(tmp_path / "film.mp4", 21)
