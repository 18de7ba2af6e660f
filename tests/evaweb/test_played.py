import pytest
from django.contrib.auth.models import Group, User

from evaweb.accounts.roles import Role, role_of
from evaweb.stations.models import Station
from tests.evaweb.played import played, state
from tests.evaweb.trials import builders


@pytest.fixture(autouse=True)
def _data(db, settings, tmp_path):
    settings.DATA_DIR = tmp_path


class Act:
    """A row that is changed, one that is added, a file in a folder of its own; each time it is played it says so."""

    def __init__(self):
        self.times = 0

    def __call__(self):
        self.times += 1
        Station.objects.update(title="Changed")
        Station.objects.create(name=f"new-{self.times}", robot="agilex_piper")


@pytest.fixture(scope="module")
def act():
    return Act()


@pytest.mark.parametrize("again", [False, True])
def test_it_is_played_once_and_each_test_begins_with_the_same(act, again, tmp_path):
    played("what is there", lambda: Station.objects.create(name="there", robot="agilex_piper"))

    def done():
        act()
        (tmp_path / "folder").mkdir(mode=0o700)
        (tmp_path / "folder" / "file").write_bytes(b"\x00said")

    played("an act of test_played", done)
    assert act.times == 1
    assert sorted(Station.objects.values_list("name", "title")) == [("new-1", ""), ("there", "Changed")]
    assert (tmp_path / "folder" / "file").read_bytes() == b"\x00said"
    assert (tmp_path / "folder").stat().st_mode & 0o777 == 0o700


def test_what_is_laid_down_is_what_was_there(tmp_path):
    def done():
        Station.objects.create(name="one", robot="agilex_piper", boot="b", active=False)
        (tmp_path / "file").write_text("said")

    played("another act", done)
    made = state()
    Station.objects.all().delete()
    (tmp_path / "file").unlink()
    played("another act", lambda: pytest.fail("it was played again"))
    assert state() == made


def test_in_another_state_it_is_played_anew(tmp_path):
    def done():
        Station.objects.create(name="one", robot="agilex_piper")

    played("a third act", done)
    Station.objects.update(name="other")
    played("a third act", done)
    assert sorted(Station.objects.values_list("name", flat=True)) == ["one", "other"]


def test_where_those_are_gone_whom_it_refers_to_it_is_played_anew():
    def done():
        builders.user("ann", "operator")

    played("of people", done)
    User.objects.all().delete()
    Group.objects.all().delete()
    Group.objects.create(name="viewer")
    played("of people", done)
    assert role_of(User.objects.get()) is Role.OPERATOR


def test_people_whom_it_does_not_refer_to_may_be_others():
    def done():
        Station.objects.create(name="one", robot="agilex_piper")

    played("of nobody", done)
    Station.objects.all().delete()
    builders.user("somebody", "operator")
    played("of nobody", lambda: pytest.fail("it was played again"))
    assert Station.objects.get().name == "one"


def test_an_act_that_removes_or_names_its_folder_is_refused(tmp_path):
    Station.objects.create(name="one", robot="agilex_piper")
    with pytest.raises(AssertionError, match="removes rows"):
        played("removal", Station.objects.all().delete)
    with pytest.raises(AssertionError, match="writes the data folder"):
        played("naming", lambda: Station.objects.create(name="two", robot="x", message=str(tmp_path)))
