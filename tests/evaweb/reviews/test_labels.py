"""The vocabulary of parts: what a lab begins with, who edits it, and what pages and programs are offered."""

from importlib import import_module

import pytest
from django.contrib.auth.models import User
from django.core.exceptions import ValidationError
from django.urls import reverse

from evaweb.reviews.models import LABEL_KEYS, SegmentLabel
from evaweb.reviews.selectors import labels_offered

pytestmark = pytest.mark.django_db
ADDRESS = "/api/v1/reviews/labels"


@pytest.fixture(autouse=True)
def _as_a_lab_begins(db):
    """Some tests empty the whole database."""
    if not SegmentLabel.objects.exists():
        rows = import_module("evaweb.reviews.migrations.0002_segment_labels").LABELS
        SegmentLabel.objects.bulk_create(
            SegmentLabel(words=words, colour=colour, key=key, order=10 * order)
            for order, (words, colour, key) in enumerate(rows, start=1)
        )


def test_a_lab_begins_with_words_that_have_a_colour_and_a_key_each():
    labels = list(labels_offered())
    assert [label.words for label in labels] == ["approach", "grasp", "transport", "place", "recover"]
    assert len({label.colour for label in labels}) == len({label.key for label in labels}) == len(labels)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"words": "Grasp"}, "There is one of these words already"),
        ({"key": "1"}, "Another label has this key"),
        ({"key": "p"}, "p was given; allowed: one of 1 2 3"),  # it passes the episode
        ({"words": "two\nlines"}, "contains the character"),
        ({"colour": "mauve"}, "not a valid choice"),
    ],
)
def test_what_no_label_can_be_is_refused_with_what_is_allowed(changes, problem):
    label = SegmentLabel(**({"words": "regrasp", "key": "6", "colour": "green"} | changes))
    with pytest.raises(ValidationError, match=problem):
        label.full_clean()


def test_its_keys_do_nothing_else_in_replay():
    assert not set(LABEL_KEYS) & set("pfn[]exugGc?-+=iolrv ")
    assert len(set(LABEL_KEYS)) == len(LABEL_KEYS)


def test_an_administrator_edits_it_and_everybody_is_offered_what_is_not_retired(client):
    SegmentLabel.objects.filter(words="recover").update(active=False)
    SegmentLabel.objects.filter(words="place").update(order=1)
    assert client.get(ADDRESS).status_code == 401
    client.force_login(User.objects.create_user("viewer"))
    told = client.get(ADDRESS).json()
    assert told[0] == {"words": "place", "colour": "teal", "key": "4"}
    assert [label["words"] for label in told[1:]] == ["approach", "grasp", "transport"]
    address = reverse("admin:reviews_segmentlabel_add")
    assert client.get(address).status_code == 302
    client.force_login(User.objects.create_superuser("root"))
    given = {"words": "regrasp", "colour": "green", "key": "6", "order": 25, "active": "on"}
    assert client.post(address, given).status_code == 302
    assert SegmentLabel.objects.get(words="regrasp").key == "6"
    assert client.get(reverse("admin:reviews_segmentlabel_changelist")).status_code == 200
