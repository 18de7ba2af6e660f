"""Real journals, as tests of episodes have them."""

from tests.evaweb.episodes.conftest import closed, data, put, recorded, station

__all__ = ["closed", "data", "put", "recorded", "station"]
