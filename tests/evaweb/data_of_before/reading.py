"""The rows, and the answers of the API, that a data folder gives."""

import csv
import io
import json
import shutil
from pathlib import Path

from django.core.serializers.json import DjangoJSONEncoder
from django.test import Client

from evaweb.api.tokens import create_token
from evaweb.collect.models import CollectSession, Demonstration, SessionEvent
from evaweb.episodes.models import Episode
from evaweb.episodes.reconcile import reconcile
from evaweb.jobs import doorbell
from evaweb.plans.models import Plan
from evaweb.plans.toml_exchange import import_file
from evaweb.results.models import Preference, Rating
from evaweb.reviews.models import Review, Segment, Standing
from evaweb.trials.models import (
    Checkpoint,
    Evaluation,
    Milestone,
    MilestoneOutcome,
    Position,
    Scene,
    Score,
    Trial,
)
from tests.evaweb.trials import builders

HERE = Path(__file__).parent
MODELS = (
    *(Scene, Position, Milestone, Checkpoint, Evaluation, Episode, Trial, Score, MilestoneOutcome),
    *(Plan, Rating, Preference, Review, Segment, Standing, CollectSession, SessionEvent, Demonstration),
)
# When rows were written, and ids that are given out as they come.
UNSTEADY = {"created_at", "changed_at", "asked_at", "id"}
NAMES = {
    "User": ("username",),
    "Station": ("name",),
    "Evaluation": ("name", "version"),
    "Position": ("scene__name", "number"),
    "Milestone": ("scene__name", "order"),
    "Plan": ("name", "version"),
    "Score": ("uuid",),
    "Trial": ("uuid",),
}


def restored(monkeypatch, settings, folder):
    """The report of a lab that has lost its database and finds this folder, and its plans in a file."""
    monkeypatch.setattr(doorbell, "notify_workers", lambda queue: True)
    settings.DATA_DIR = folder / "data"
    shutil.copytree(HERE / "disk", settings.DATA_DIR)
    import_file(user=builders.user("adam", "admin"), text=(HERE / "lab.toml").read_text("utf-8"))
    return reconcile()


def rows():
    """What the tables say, in plain JSON, rows named by what does not change."""
    told = {model.__name__: [_row(row) for row in model.objects.all()] for model in MODELS}
    plain = json.loads(json.dumps(told, cls=DjangoJSONEncoder))
    return {model: sorted(found, key=json.dumps) for model, found in plain.items()}


def answers():
    """What the API says of the trials: the list, each of them, and the download."""
    token = create_token(user=builders.user("vic", "viewer"), name="tests")

    def get(path, **query):
        return Client().get(f"/api/v1/{path}", query, headers={"Authorization": f"Bearer {token}"})

    listed = get("trials", limit=100).json()["items"]
    details = [get(f"trials/{trial['id']}").json() for trial in listed]
    assert [{name: row[name] for name in listed[0]} for row in details] == listed
    text = b"".join(get("trials", format="csv").streaming_content).decode()
    table = list(csv.reader(io.StringIO(text, newline="")))
    return {"trials": details, "csv": table}


def _row(row):
    fields = [field for field in row._meta.concrete_fields if field.name not in UNSTEADY]
    told = {field.name: _value(row, field) for field in fields}
    return {**told, "pk": row.pk} if isinstance(row, Trial) else told


def _value(row, field):
    other = getattr(row, field.name) if field.is_relation else None
    if other is None:
        return field.value_from_object(row)
    names = NAMES.get(type(other).__name__, ("pk" if field.target_field.name == "uuid" else "name",))
    return list(type(other).objects.filter(pk=other.pk).values_list(*names).get())
