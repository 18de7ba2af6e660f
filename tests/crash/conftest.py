import pytest

from runtime.core.errors import RuntimeFault
from tests.crash.lab import Lab


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A node and a policy server for all stations of a file, and the station of tests that leave one whole."""
    made = Lab(tmp_path_factory.mktemp("shared")).node().server()
    yield made
    made.close()


@pytest.fixture
def station(shared, request):
    """The shared station, at rest; none that a test failed on."""
    failed = request.session.testsfailed
    try:
        shared.rest()
    except RuntimeFault:
        shared.end()
        raise
    yield shared
    if request.session.testsfailed > failed:
        shared.end()


@pytest.fixture
def lab(tmp_path, shared):
    """A station of its own; what its test does to a node or a policy server it does to one that it starts."""
    shared.end()  # the node obeys one station at a time
    made = Lab(tmp_path, shared.addresses)
    yield made
    made.close()
