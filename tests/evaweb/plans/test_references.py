"""Reference pictures travel between labs in an archive."""

import contextlib
import hashlib
import io
import tomllib
import zipfile

import pytest
from django.core.files.uploadedfile import SimpleUploadedFile
from django.core.management import call_command
from django.urls import reverse

from evaweb.core.errors import EvaError
from evaweb.plans import image_store, references
from evaweb.plans.models import Reference
from evaweb.plans.references import unpacked
from evaweb.plans.toml_exchange import export_archive, export_toml, import_file
from tests.evaweb.plans.lab import jpeg
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import without_triggers


@pytest.fixture
def admin(db):
    return builders.user("adam", "admin")


@pytest.fixture
def taken(bench, owner):
    """Two cameras' references at position 1, one of them taken twice, and one of a camera at all."""
    first = bench.scene.positions.get(number=1)
    for camera, seed, position in (
        ("top", 1, first),
        ("top", 2, first),
        ("left", 3, first),
        ("top", 4, None),
    ):
        name = image_store.store_image(jpeg(seed))
        Reference.objects.create(
            station=bench.station, position=position, camera=camera, picture=name, by=owner
        )
    return bench


def lose():
    with without_triggers("plans"):
        Reference.objects.all().delete()


def elsewhere(settings, tmp_path):
    """Another lab: the same stations, other disks."""
    settings.DATA_DIR = tmp_path / "elsewhere"


def take(content, user):
    text, found = unpacked(content)
    return import_file(user=user, text=text, pictures=found)


def archive(**files):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as made:
        for name, value in files.items():
            made.writestr(name.replace("__", "/").replace("_dot_", "."), value)
    return content.getvalue()


def test_the_toml_names_the_newest_picture_of_each_camera_at_each_position(taken):
    rows = tomllib.loads(export_toml(scenes=[taken.scene]))["reference"]
    where = {"scene": taken.scene.name, "position": 1, "station": "bench-1"}
    digests = [hashlib.sha256(jpeg(seed)).hexdigest() for seed in (3, 2)]
    assert rows == [
        {**where, "camera": "left", "picture": digests[0]},
        {**where, "camera": "top", "picture": digests[1]},
    ]


def test_another_lab_gets_them_with_the_archive(taken, admin, settings, tmp_path):
    content = export_archive(scenes=[taken.scene])
    with zipfile.ZipFile(io.BytesIO(content)) as made:
        assert len(made.namelist()) == 3
    lose()
    elsewhere(settings, tmp_path)
    line = f"reference pictures of scene {taken.scene.name}: "
    assert take(content, admin) == [f"scene {taken.scene.name}: the same", line + "2 new"]
    found = {row.camera: row for row in Reference.objects.all()}
    assert image_store.load_image(found["top"].picture) == jpeg(2)
    assert (found["top"].by, found["top"].position.number) == (admin, 1)
    assert take(content, admin)[1] == line + "2 the same"
    assert Reference.objects.count() == 2


def test_what_a_lab_has_itself_stays(taken, admin):
    content = export_archive(scenes=[taken.scene])
    own = image_store.store_image(jpeg(9))
    first = taken.scene.positions.get(number=1)
    Reference.objects.create(station=taken.station, position=first, camera="top", picture=own, by=admin)
    assert take(content, admin)[1].endswith(": 1 the same, 1 left out, because this lab has its own")
    assert Reference.objects.filter(camera="top", position=first).first().picture == own


def test_without_the_archive_and_without_the_station_it_is_said(taken, admin, settings, tmp_path):
    text = export_toml(scenes=[taken.scene])
    lose()
    elsewhere(settings, tmp_path)
    assert import_file(user=admin, text=text)[1].endswith(
        "2 left out, because the file lacks their pictures: import the archive"
    )
    other = import_file(user=admin, text=text.replace('station = "bench-1"', 'station = "far"'))
    assert other[1].endswith("2 left out, because there is no station far")
    assert Reference.objects.count() == 0


def test_a_picture_that_the_disk_has_lost_is_left_out_of_the_archive(taken, settings):
    lost = hashlib.sha256(jpeg(2)).hexdigest()
    (settings.DATA_DIR / "pictures" / f"{lost}.jpg").unlink()
    with zipfile.ZipFile(io.BytesIO(export_archive(scenes=[taken.scene]))) as made:
        assert f"pictures/{lost}.jpg" not in made.namelist()
        assert len(made.namelist()) == 2


def test_what_is_no_such_archive_is_refused_and_named(taken, monkeypatch):
    good = hashlib.sha256(jpeg(1)).hexdigest()
    text = hashlib.sha256(b"x").hexdigest()
    for files, said in (
        ({}, "has 0 TOML files"),
        ({"a_dot_toml": "", "b_dot_toml": ""}, "has 2 TOML files"),
        ({"a_dot_toml": "", "pictures__.._dot_sh": "x"}, "pictures/...sh'; allowed: one TOML"),
        ({"a_dot_toml": "", f"pictures__{good}_dot_jpg": "x"}, "another SHA-256 than its name"),
        ({"a_dot_toml": "", f"pictures__{text}_dot_jpg": "x"}, "this is no JPEG"),
        ({"a_dot_toml": b"\xff"}, "a.toml is not a text"),
    ):
        with pytest.raises(EvaError, match=said):
            unpacked(archive(**files))
    with pytest.raises(EvaError, match="cannot be read"):
        unpacked(b"PK\x03\x04 and nothing else")
    with pytest.raises(EvaError, match="is not a text"):
        unpacked(b"\xff\xfe")
    monkeypatch.setattr(references, "LARGEST_PICTURE", 100)
    with pytest.raises(EvaError, match="more than 100 bytes"):
        unpacked(export_archive(scenes=[taken.scene]))
    monkeypatch.setattr(references, "LARGEST", 1000)
    with pytest.raises(EvaError, match="1000 bytes in all"):
        unpacked(export_archive(scenes=[taken.scene]))


@pytest.mark.parametrize("packed", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_an_archive_that_is_damaged_anywhere_is_refused(packed):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", packed) as made:
        made.writestr("lab.toml", "# words\n" + "\n".join(f"# {number}" for number in range(500)))
    whole = content.getvalue()
    assert unpacked(whole)[1] == {}
    for at in range(30, len(whole), 7):
        damaged = whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :]
        with contextlib.suppress(EvaError):
            unpacked(damaged)


def test_the_admin_pages_and_the_command_write_and_take_archives(
    taken, draft, admin, client, settings, tmp_path
):
    client.force_login(admin)
    content = client.get(reverse("admin:plans_plan_export") + "?pictures").content
    chosen = {"action": "export_archive", "_selected_action": [draft.pk]}
    action = client.post(reverse("admin:plans_plan_changelist"), chosen)
    assert 'filename="blocks.zip"' in action["Content-Disposition"]
    assert unpacked(action.content)[1].keys() == unpacked(content)[1].keys()
    call_command("plans", "export", "--archive", str(tmp_path / "lab.zip"))
    assert unpacked((tmp_path / "lab.zip").read_bytes()) == unpacked(content)
    lose()
    elsewhere(settings, tmp_path)
    upload = SimpleUploadedFile("lab.zip", content)
    page = client.post(reverse("admin:plans_plan_import"), {"file": upload}, follow=True).content.decode()
    assert f"Reference pictures of scene {taken.scene.name}: 2 new" in page
    call_command("plans", "import", str(tmp_path / "lab.zip"), "--user", "adam")
    assert Reference.objects.count() == 2


BLOCK = {"name": "block", "x": 0.25, "y": 0.34, "width": 0.25, "height": 0.33}


def test_regions_go_with_their_picture(taken, admin, settings, tmp_path):
    row = Reference.objects.filter(camera="top", position__number=1).first()
    Reference.objects.create(
        station=row.station,
        position=row.position,
        camera="top",
        picture=row.picture,
        regions=[BLOCK],
        by=admin,
    )
    content = export_archive(scenes=[taken.scene])
    lose()
    elsewhere(settings, tmp_path)
    assert take(content, admin)[1].endswith(": 2 new")
    assert [found.regions for found in Reference.objects.order_by("camera")] == [[], [BLOCK]]
    assert take(content, admin)[1].endswith(": 2 the same")
    own = Reference.objects.get(camera="top")
    Reference.objects.create(
        station=own.station, position=own.position, camera="top", picture=own.picture, by=admin
    )
    assert take(content, admin)[1].endswith(": 1 the same, 1 left out, because this lab has its own")


def test_regions_of_a_file_that_cannot_be_are_refused(taken, admin):
    text = export_toml(scenes=[taken.scene])
    lose()
    for given, said in (
        ("{name = 'block', x = 0.9, y = 0.1, width = 0.2, height = 0.2}", "beyond the picture"),
        ("{name = 'block', x = 0.9, y = 0.1, width = 0.01, height = 0.2}", "8 x 8 or more"),
    ):
        with pytest.raises(EvaError, match=said):
            import_file(user=admin, text=text + f"regions = [{given}]\n")
    assert Reference.objects.count() == 0
