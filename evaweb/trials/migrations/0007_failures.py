import django.core.validators
import django.db.models.functions.text
from django.db import migrations, models

from evaweb.records.append_only import triggers_suspended

# level, words, key: what a lab begins with, in this order.
TERMS = (
    ("phase", "approach", "a"),
    ("phase", "grasp", "g"),
    ("phase", "transport", "t"),
    ("phase", "place", "e"),
    ("phase", "other", "o"),
    ("cause", "missed", "m"),
    ("cause", "dropped", "d"),
    ("cause", "collision", "c"),
    ("cause", "timeout", "i"),
    ("cause", "wrong object", "w"),
    ("cause", "safety stop", "f"),
    ("cause", "policy stuck", "y"),
    ("cause", "hardware", "h"),
)


def make_terms(apps, editor):
    terms = apps.get_model("trials", "FailureTerm").objects.using(editor.connection.alias)
    for order, (level, words, key) in enumerate(TERMS, start=1):
        terms.create(level=level, words=words, key=key, order=10 * order)


class Migration(migrations.Migration):
    dependencies = [
        ("trials", "0006_void_requests"),
    ]

    operations = [
        migrations.RunPython(triggers_suspended, migrations.RunPython.noop),
        migrations.AddField(
            model_name="scene",
            name="failure_required",
            field=models.BooleanField(
                default=False,
                help_text="A failed trial is not scored without the phase in which it failed, and the cause.",
                verbose_name="failures explained",
            ),
        ),
        migrations.AddField(
            model_name="score",
            name="failure_phase",
            field=models.CharField(
                blank=True, default="", help_text="The phase in which it did.", max_length=60
            ),
            preserve_default=False,
        ),
        migrations.CreateModel(
            name="FailureTerm",
            fields=[
                (
                    "id",
                    models.BigAutoField(
                        auto_created=True, primary_key=True, serialize=False, verbose_name="ID"
                    ),
                ),
                (
                    "level",
                    models.CharField(choices=[("phase", "phase"), ("cause", "cause")], max_length=5),
                ),
                (
                    "words",
                    models.CharField(
                        help_text="As scores have it.",
                        max_length=60,
                        validators=[django.core.validators.ProhibitNullCharactersValidator()],
                    ),
                ),
                (
                    "key",
                    models.CharField(
                        blank=True,
                        help_text="Chooses it at scoring, pressed with Shift: one of a b c d e f g h i j m n o q t v w y z "
                        "that no other has.",
                        max_length=1,
                        validators=[
                            django.core.validators.RegexValidator(
                                "\\A[abcdefghijmnoqtvwyz]\\Z",
                                "%(value)s was given; allowed: one of a b c d e f g h i j m n o q t v w y z, or none",
                            )
                        ],
                    ),
                ),
                ("order", models.PositiveSmallIntegerField(default=0, help_text="Among those of its level.")),
                (
                    "active",
                    models.BooleanField(default=True, help_text="Off: retired, not offered; scores keep it."),
                ),
            ],
            options={
                "verbose_name": "failure phase or cause",
                "verbose_name_plural": "failure phases and causes",
                "ordering": ("-level", "order", "pk"),
            },
        ),
        migrations.AddConstraint(
            model_name="failureterm",
            constraint=models.UniqueConstraint(
                django.db.models.functions.text.Lower("words"),
                models.F("level"),
                name="failure_term_once",
                violation_error_message="There is one of these words already; one that is retired can be switched on.",
            ),
        ),
        migrations.AddConstraint(
            model_name="failureterm",
            constraint=models.UniqueConstraint(
                condition=models.Q(("key", ""), _negated=True),
                fields=("key",),
                name="failure_key_once",
                violation_error_message="Another phase or cause has this key; a retired one keeps its own until it is "
                "emptied.",
            ),
        ),
        migrations.RunPython(make_terms, triggers_suspended),
    ]
