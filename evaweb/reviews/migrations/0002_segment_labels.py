import django.core.validators
import django.db.models.functions.text
from django.db import migrations, models

import evaweb.core.printed_names

# Words, colour, key: what a lab begins with, in this order.
LABELS = (
    ("approach", "blue", "1"),
    ("grasp", "orange", "2"),
    ("transport", "violet", "3"),
    ("place", "teal", "4"),
    ("recover", "yellow", "5"),
)


def make_labels(apps, editor):
    labels = apps.get_model("reviews", "SegmentLabel").objects.using(editor.connection.alias)
    for order, (words, colour, key) in enumerate(LABELS, start=1):
        labels.create(words=words, colour=colour, key=key, order=10 * order)


class Migration(migrations.Migration):
    dependencies = [
        ("reviews", "0001_initial"),
    ]

    operations = [
        migrations.CreateModel(
            name="SegmentLabel",
            fields=[
                (
                    "id",
                    models.BigAutoField(
                        auto_created=True, primary_key=True, serialize=False, verbose_name="ID"
                    ),
                ),
                (
                    "words",
                    models.CharField(
                        help_text="As segments have it.",
                        max_length=120,
                        validators=[evaweb.core.printed_names.check_name],
                    ),
                ),
                (
                    "colour",
                    models.CharField(
                        choices=[
                            ("blue", "blue"),
                            ("orange", "orange"),
                            ("violet", "violet"),
                            ("teal", "teal"),
                            ("green", "green"),
                            ("yellow", "yellow"),
                            ("red", "red"),
                            ("grey", "grey"),
                        ],
                        default="blue",
                        max_length=8,
                    ),
                ),
                (
                    "key",
                    models.CharField(
                        blank=True,
                        help_text="Begins and ends such a part in Replay: one of 1 2 3 4 5 6 7 8 9 0 a b d h j k m q s t w y z that no other has.",
                        max_length=1,
                        validators=[
                            django.core.validators.RegexValidator(
                                "\\A[1234567890abdhjkmqstwyz]\\Z",
                                "%(value)s was given; allowed: one of 1 2 3 4 5 6 7 8 9 0 a b d h j k m q s t w y z, or none",
                            )
                        ],
                    ),
                ),
                ("order", models.PositiveSmallIntegerField(default=0)),
                (
                    "active",
                    models.BooleanField(
                        default=True, help_text="Off: retired, not offered; segments keep it."
                    ),
                ),
            ],
            options={
                "ordering": ("order", "pk"),
                "constraints": [
                    models.UniqueConstraint(
                        django.db.models.functions.text.Lower("words"),
                        name="segment_label_once",
                        violation_error_message="There is one of these words already; one that is retired can be switched on.",
                    ),
                    models.UniqueConstraint(
                        condition=models.Q(("key", ""), _negated=True),
                        fields=("key",),
                        name="segment_label_key_once",
                        violation_error_message="Another label has this key; a retired one keeps its own until it is emptied.",
                    ),
                ],
            },
        ),
        migrations.RunPython(make_labels, migrations.RunPython.noop),
    ]
