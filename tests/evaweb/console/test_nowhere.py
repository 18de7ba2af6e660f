"""A socket of nothing that there is is closed with a code, whatever its address says."""

from urllib.parse import quote

import pytest
from channels.testing import WebsocketCommunicator

from evaweb.asgi import application
from evaweb.console.consumers import NO_STATION
from tests.evaweb.console.page import Page, run
from tests.processes import PATIENCE_S

pytestmark = pytest.mark.django_db(transaction=True)
ODD = ["x" * 3000, "\x00", "\udc80", "🤖" * 100, "\n"]


@pytest.mark.parametrize("path", ["other", "stations/", "stations/a/b", "../../etc", *ODD])
def test_where_there_is_none(path):
    async def scenario():
        address = f"/ws/{quote(path, errors='surrogateescape')}"
        headers = [(b"origin", b"http://localhost"), (b"host", b"localhost")]
        socket = WebsocketCommunicator(application, address, headers)
        assert (await socket.connect(timeout=PATIENCE_S))[0]
        assert (await socket.receive_output(PATIENCE_S))["code"] == NO_STATION

    run(scenario())


@pytest.mark.parametrize("name", ODD)
def test_of_a_station_that_cannot_be(name, vera):
    async def scenario():
        page = Page(quote(name, errors="surrogateescape"), vera)
        assert await page.connected()
        closed = await page._socket.receive_output(PATIENCE_S)
        assert closed["code"] == NO_STATION
        assert len(closed["reason"].encode()) <= 123

    run(scenario())
