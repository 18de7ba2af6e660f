import pytest

from tests.crash.lab import Lab


@pytest.fixture(scope="module")
def peers(tmp_path_factory):
    """The addresses of a node and a policy server that stand for all stations of a file."""
    made = Lab(tmp_path_factory.mktemp("peers")).node().server()
    yield made.addresses
    made.close()


@pytest.fixture
def lab(tmp_path, peers):
    """A station of its own; what its test does to a node or a policy server it does to one that it starts."""
    made = Lab(tmp_path, peers)
    yield made
    made.close()
