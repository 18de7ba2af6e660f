"""Crates of other labs: what is refused, what is shown to whom, and how they are removed."""

import copy
import hashlib
import io
import json
import stat
import struct
import zipfile

import pytest
from django.core.files.uploadedfile import SimpleUploadedFile
from django.core.management import CommandError, call_command
from django.urls import reverse

from evaweb.blinding.visibility import visibility_for_user
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.jobs.locks import exclusive_job
from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.models import Plan
from evaweb.plans.services import close_plan, freeze_plan, reveal_plan
from evaweb.results.crates import hostile_zips
from evaweb.results.crates.foreign import METADATA, read_foreign_crate
from evaweb.results.crates.imported import (
    crate_file,
    hidden_crates,
    import_crate,
    imported_crates,
    remove_crate,
)
from evaweb.results.models import ImportedCrate
from evaweb.trials.models import Checkpoint
from tests.evaweb.results.crates.foreign_crates import foreign_crate, foreign_files, foreign_metadata, packed
from tests.evaweb.results.crates.test_export import crate_of
from tests.evaweb.trials import builders


@pytest.fixture
def alma(db):
    return builders.user("alma", "admin")


def changed(path, content):
    """A crate of which one file was changed afterwards."""
    files = foreign_files()
    return packed(files | {path: content}, foreign_metadata(files))


def with_metadata(change):
    files = foreign_files()
    metadata = copy.deepcopy(foreign_metadata(files))
    change({entity["@id"]: entity for entity in metadata["@graph"]}, metadata)
    return packed(files, metadata)


def plan_rewritten():
    """Another plan, with the right SHA-256 of the file, and the seal of before."""
    files = foreign_files()
    plan = json.loads(files["data/plan.json"]) | {"question": "Is mine better?"}
    return packed(files | {"data/plan.json": json.dumps(plan).encode()})


def named_entry(name, **facts):
    target = foreign_crate()
    with zipfile.ZipFile(target, "a") as archive:
        entry = zipfile.ZipInfo("placeholder" if "\\" in name else name)
        entry.filename = name
        for key, value in facts.items():
            setattr(entry, key, value)
        archive.writestr(entry, b"x")
    return target


def encrypted():
    content = bytearray(foreign_crate().getvalue())
    at = content.index(b"PK\x01\x02")
    struct.pack_into("<H", content, at + 8, 1)
    return io.BytesIO(bytes(content))


def short_of_what_it_declares():
    content = bytearray(foreign_crate().getvalue())
    at = content.index(b"PK\x01\x02")
    (size,) = struct.unpack_from("<I", content, at + 24)
    struct.pack_into("<I", content, at + 24, size + 1)
    return io.BytesIO(bytes(content))


def bomb():
    return packed(foreign_files(**{"data/zeros.csv": bytes(hostile_zips.LEAST_BOUND)}))


def half_a_character():
    """A plan without a canonical form, in a key that nothing else reads."""
    files, metadata = foreign_files(), foreign_metadata(foreign_files())
    files["data/plan.json"] = files["data/plan.json"][:-1] + b', "x": "\\ud800"}'
    (entity,) = (row for row in metadata["@graph"] if row["@id"] == "data/plan.json")
    entity["sha256"] = hashlib.sha256(files["data/plan.json"]).hexdigest()
    return packed(files, metadata)


def with_json(name, change):
    """A crate whose digests agree, of which one document was changed before."""
    files = foreign_files()
    document = json.loads(files[name])
    change(document)
    return packed(files | {name: json.dumps(document).encode()})


def beyond_all_files():
    """A crate whose first entry begins where no file can, by a zip64 field."""
    content = foreign_crate().getvalue()
    end = content.rindex(b"PK\x05\x06")
    (begin,) = struct.unpack_from("<I", content, end + 16)
    listed, last = bytearray(content[begin:end]), bytearray(content[end:])
    after_name = 46 + struct.unpack_from("<H", listed, 28)[0]
    struct.pack_into("<H", listed, 30, 12)
    struct.pack_into("<I", listed, 42, 0xFFFFFFFF)
    listed[after_name:after_name] = struct.pack("<HHQ", 1, 8, 2**63 - 1)
    struct.pack_into("<I", last, 12, len(listed))
    return io.BytesIO(content[:begin] + listed + last)


def long_list():
    """A zip of nothing but a list of files, each of which would take half a kilobyte of memory."""
    entry = b"PK\x01\x02" + bytes(24) + struct.pack("<H", 1) + bytes(16) + b"a"
    listed = entry * (13_000_000 // len(entry))
    return io.BytesIO(listed + b"PK\x05\x06" + bytes(8) + struct.pack("<IIH", len(listed), 0, 0))


REFUSED = {
    "no zip": (lambda: io.BytesIO(b"PK\x03\x04 and no more"), "no zip that can be read"),
    "cut": (lambda: io.BytesIO(foreign_crate().getvalue()[:900]), "no zip that can be read"),
    "damaged": (
        lambda: io.BytesIO(foreign_crate().getvalue().replace(b"PK\x01\x02", b"PK\x01\x03")),
        "no zip",
    ),
    "path above": (lambda: named_entry("../up"), "'../up'"),
    "absolute path": (lambda: named_entry("/etc/passwd"), "'/etc/passwd'"),
    "drive": (lambda: named_entry("C:/x"), "'C:/x'"),
    "backslash": (lambda: named_entry("a\\b"), r"'a\\\\b'"),
    "control character": (lambda: named_entry("a\nb"), "in one line"),
    "link": (
        lambda: named_entry("l", external_attr=(stat.S_IFLNK | 0o777) << 16),
        "l in the crate is a link",
    ),
    "twice": (lambda: named_entry("data/plan.json"), "'data/plan.json' twice"),
    "encrypted": (encrypted, "encrypted"),
    "other method": (lambda: named_entry("x", compress_type=zipfile.ZIP_LZMA), "uncommon way"),
    "wrong length": (short_of_what_it_declares, "not as long as it declares|no zip that can be read"),
    "bomb": (bomb, "once unpacked"),
    "not listed": (lambda: named_entry("extra.txt"), "extra.txt is in the crate, and not in its metadata"),
    "no metadata": (lambda: io.BytesIO(zipped({"a": b"b"})), f"{METADATA} is not at its top"),
    "no json": (lambda: io.BytesIO(zipped({METADATA: b"{"})), f"{METADATA} in the crate: is not valid JSON"),
    "deep": (lambda: io.BytesIO(zipped({METADATA: b"[" * 9000})), "within each other"),
    "no crate": (
        lambda: with_metadata(lambda by_id, _: by_id[METADATA].pop("conformsTo")),
        "does not describe",
    ),
    "no part": (lambda: with_metadata(lambda by_id, _: by_id["./"].pop("hasPart")), "not in its metadata"),
    "no digest": (
        lambda: with_metadata(lambda by_id, _: by_id["data/seal.json"].pop("sha256")),
        "no SHA-256 of",
    ),
    "absent file": (
        lambda: with_metadata(lambda by_id, _: by_id["./"]["hasPart"].append({"@id": "data/trials.csv"})),
        "data/trials.csv is in the metadata of the crate, and not in the crate",
    ),
    "changed file": (lambda: changed("data/numbers.json", b'{"n": 9, "arms": {}}'), "its SHA-256 differs"),
    "changed plan": (plan_rewritten, "another digest than data/seal.json states"),
    "other identifier": (
        lambda: with_metadata(lambda by_id, _: by_id["#plan-digest"].update(value="0" * 64)),
        f"another digest than {METADATA} states",
    ),
    "not of an evaluation": (lambda: packed({"a.txt": b"a"}), "no data/plan.json"),
    "no counts": (
        lambda: packed(foreign_files(**{"data/numbers.json": b'{"n": -1, "arms": {}}'})),
        "data/numbers.json in the crate: n: ",
    ),
    "beyond all files": (beyond_all_files, "no zip that can be read"),
    "long list": (long_list, "the list of files in the crate has .* bytes"),
    "folder with content": (lambda: named_entry("hidden/"), "a folder with content"),
    "half a character in a path": (
        lambda: with_metadata(lambda by_id, _: by_id["./"]["hasPart"].append({"@id": "\ud800"})),
        "\ufffd is in the metadata",
    ),
    "more successes than trials": (
        lambda: with_json("data/numbers.json", lambda found: found["arms"]["cup-policy"].update(successes=5)),
        "arms.cup-policy: .*5 successes of 4 trials",
    ),
    "much text": (
        lambda: with_json(
            "data/seal.json", lambda seal: seal["at_reveal"].update(headline=["x" * 8000] * 100)
        ),
        "what pages would show of the crate has",
    ),
    "half a character": (half_a_character, "data/plan.json in the crate: .*surrogates not allowed"),
}


def zipped(files):
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        for path, content in files.items():
            archive.writestr(path, content)
    return target.getvalue()


@pytest.mark.parametrize("what", REFUSED)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_bad_crate_is_named_and_leaves_nothing(alma, settings, what):
    make, why = REFUSED[what]
    with pytest.raises(EvaError, match=why) as refused:
        import_crate(user=alma, file=make())
    assert str(refused.value).encode()  # can be shown
    assert not ImportedCrate.objects.exists()
    assert not list(settings.DATA_DIR.glob("crates/*"))


def test_a_crate_is_kept_as_it_came_once_and_shown_with_its_origin(alma, client):
    file = foreign_crate(title="Cups <b>there</b>")
    row = import_crate(user=alma, file=file)
    assert row.sha256 == hashlib.sha256(file.getvalue()).hexdigest()
    assert crate_file(row.sha256).read_bytes() == file.getvalue()
    with pytest.raises(Conflict, match="imported already, by alma"):
        import_crate(user=alma, file=file)
    client.force_login(builders.user("vera", "viewer"))
    page = client.get(reverse("imported-crate", args=[row.sha256])).content.decode()
    for said in ("The Other Lab", "0000-0002-1825-0097", "CC-BY-4.0", "the first was better", row.sha256):
        assert said in page
    assert "2/4, 50 % [15, 85]" in page
    assert "Cups &lt;b&gt;there&lt;/b&gt;" in page
    assert "Cups, elsewhere" in client.get(reverse("crates")).content.decode()
    rest = client.get(reverse("api:imported-crate", args=[row.sha256])).json()
    assert (rest["sealed"], rest["content"]["origin"]["lab"]) == (False, "The Other Lab")
    assert client.get(reverse("api:crates")).json()["total"] == 1
    for name in ("imported-crate-file", "api:imported-crate-file"):
        answer = client.get(reverse(name, args=[row.sha256]))
        assert b"".join(answer.streaming_content) == file.getvalue()
        assert answer["Content-Disposition"].startswith("attachment")


def test_without_its_row_a_file_is_not_kept_unless_it_was_there(alma, monkeypatch):
    def fail(row, **options):
        raise OSError("no database")

    file = foreign_crate()
    path = crate_file(hashlib.sha256(file.getvalue()).hexdigest())
    with monkeypatch.context() as without:
        without.setattr(ImportedCrate, "save", fail)
        with pytest.raises(OSError, match="no database"):
            import_crate(user=alma, file=file)
        assert not path.exists()
        path.write_bytes(file.getvalue())  # as after a lost database
        with pytest.raises(OSError, match="no database"):
            import_crate(user=alma, file=file)
    with path.open("rb") as there:
        import_crate(user=alma, file=there)
    assert path.read_bytes() == file.getvalue()


def test_what_one_lab_exports_another_one_imports(revealed, alma):
    content, _ = crate_of(revealed, name="Blocks at ours")
    row = import_crate(user=alma, file=io.BytesIO(content))
    assert row.content["origin"]["name"] == "Blocks at ours"
    assert row.content["seal"]["digest"] == revealed.digest
    assert {arm["checkpoint"]: arm["successes"] for arm in row.content["arms"]} == {
        "pi0-new": 6,
        "pi0-block": 2,
    }


def test_administrators_import_and_remove_and_others_do_not(alma, client, settings, tmp_path, capsys):
    file = foreign_crate()
    sent = {"file": SimpleUploadedFile("crate.zip", file.getvalue())}
    for name, role in (("vera", "viewer"), ("otto", "operator")):
        user = builders.user(name, role)
        client.force_login(user)
        assert client.post(reverse("crate-import"), sent).status_code == 403
        with pytest.raises(NotAllowed):
            import_crate(user=user, file=file)
        assert "Import a crate" not in client.get(reverse("crates")).content.decode()
    client.force_login(alma)
    assert "choose the zip" in client.post(reverse("crate-import")).content.decode()
    sent["file"].seek(0)
    shown = client.post(reverse("crate-import"), sent, follow=True)
    assert "The Other Lab" in shown.content.decode()
    row = imported_crates().get()
    otto = builders.user("olaf", "operator")
    client.force_login(otto)
    assert client.post(reverse("imported-crate-remove", args=[row.sha256])).status_code == 403
    assert client.delete(reverse("api:imported-crate", args=[row.sha256])).status_code == 403
    client.force_login(alma)
    listed = client.post(reverse("imported-crate-remove", args=[row.sha256]), follow=True).content.decode()
    assert "Removed crates, 1" in listed
    assert client.get(reverse("imported-crate", args=[row.sha256])).status_code == 404
    row.refresh_from_db()
    assert (row.content, row.removed_by) == ({}, alma)
    path = tmp_path / "other.zip"
    path.write_bytes(file.getvalue())
    call_command("crates", "import", str(path), "--user", "alma")
    assert "its digests agree" in capsys.readouterr().out
    assert imported_crates().count() == 1
    with pytest.raises(CommandError, match="imported already"):
        call_command("crates", "import", str(path), "--user", "alma")


@pytest.mark.django_db(transaction=True)
def test_removal_takes_the_file_away(alma, client):
    row = import_crate(user=alma, file=foreign_crate())
    client.force_login(alma)
    assert client.delete(reverse("api:imported-crate", args=[row.sha256])).status_code == 200
    assert not crate_file(row.sha256).exists()


WEIGHTS = "a1" * 32


@pytest.mark.parametrize(
    "checkpoints",
    [
        {"PI0-new": "", "far-policy": ""},
        {"renamed": WEIGHTS.upper(), "far-policy": ""},
        {"pi0-new, retrained": "", "far-policy": ""},
    ],
)
def test_a_crate_with_a_checkpoint_of_a_blind_plan_is_sealed_until_the_reveal(
    bench, owner, alma, client, checkpoints, request
):
    Checkpoint.objects.filter(pk=bench.checkpoint.pk).update(digest=WEIGHTS)
    plan = request.getfixturevalue("plan")
    row = import_crate(user=alma, file=foreign_crate(checkpoints=checkpoints))
    unrelated = import_crate(user=alma, file=foreign_crate(title="Unrelated"))
    for user in (bench.operator, alma):
        client.force_login(user)
        assert client.get(reverse("imported-crate", args=[unrelated.sha256])).status_code == 200
        page = client.get(reverse("imported-crate", args=[row.sha256])).content.decode()
        listed = client.get(reverse("crates")).content.decode()
        rest = client.get(reverse("api:imported-crate", args=[row.sha256])).json()
        assert (rest["sealed"], rest["content"]) == (True, None)
        assert "Blocks v1 is blind until it is revealed" in page
        assert (page.count("Cups, elsewhere"), listed.count("Cups, elsewhere")) == (0, 1)  # the unrelated one
        assert not any(name in page + listed for name in checkpoints)
        for name in ("imported-crate-file", "api:imported-crate-file"):
            assert client.get(reverse(name, args=[row.sha256])).status_code == 403
    record_unblinding(plan, owner)
    assert hidden_crates([row], visibility_for_user(owner)) == set()
    reveal_plan(user=owner, plan=close_plan(user=owner, plan=plan, reason="enough"))
    assert hidden_crates([row], visibility_for_user(bench.operator)) == set()


def test_a_crate_of_this_lab_is_sealed_whatever_its_checkpoints_are_called_now(revealed, bench, owner, alma):
    own = import_crate(user=alma, file=io.BytesIO(crate_of(revealed)[0]))
    assert hidden_crates([own], visibility_for_user(bench.operator)) == set()
    for checkpoint in revealed.checkpoints.all():
        checkpoint.name = f"again-{checkpoint.pk}"
        checkpoint.save()
    again = Plan.objects.create(
        name="again", title="Again", owner=owner, first=revealed.first, second=revealed.second
    )
    again.checkpoints.set(revealed.checkpoints.all())
    again.positions.set(revealed.positions.all())
    freeze_plan(user=owner, plan=again)
    assert hidden_crates([own], visibility_for_user(bench.operator)) == {own.pk}


def test_an_import_and_a_removal_of_one_crate_never_overlap(alma):
    row = import_crate(user=alma, file=foreign_crate())
    with exclusive_job(f"crate {row.sha256}", None), pytest.raises(Conflict, match="try again"):
        remove_crate(user=alma, crate=row)
    assert crate_file(row.sha256).exists()
    remove_crate(user=alma, crate=row)
    with exclusive_job(f"crate {row.sha256}", None), pytest.raises(Conflict, match="try again"):
        import_crate(user=alma, file=foreign_crate())
    assert not imported_crates().exists()


@pytest.mark.parametrize("address", ["https://orcid.org/", "https://orcid.org/0000-0002-1825-0098"])
def test_an_orcid_with_a_wrong_check_digit_is_not_shown_as_one(address):
    files = foreign_files()
    metadata = json.dumps(foreign_metadata(files)).replace("https://orcid.org/0000-0002-1825-0097", address)
    people = read_foreign_crate(packed(files, json.loads(metadata)))["origin"]["people"]
    assert people == [{"name": "josiah", "orcid": ""}]


def test_all_crates_are_reached_page_by_page(alma, client):
    content = read_foreign_crate(foreign_crate())
    ImportedCrate.objects.bulk_create(
        ImportedCrate(sha256=f"{number:064x}", size=1, content=content, imported_by=alma)
        for number in range(120)
    )
    client.force_login(alma)
    pages = "".join(client.get(reverse("crates"), {"page": page}).content.decode() for page in (1, 2, 3))
    assert all(reverse("imported-crate", args=[f"{number:064x}"]) in pages for number in range(120))


def test_it_is_read_without_the_characters_that_a_database_refuses():
    metadata = foreign_metadata(foreign_files())
    metadata["@graph"][0]["name"] = "a\x00b\ud800\u202ec"
    assert read_foreign_crate(packed(foreign_files(), metadata))["origin"]["name"] == "a\ufffdb\ufffd\ufffdc"
