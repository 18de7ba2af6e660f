"""A plan says what an e-stop, another interruption and a time-out count as; those of before left it to the operator."""

from django.db import migrations, models

_ENDS = [
    ("judged", "judged: the operator scores it, or has it repeated"),
    ("failure", "a failure of its checkpoint"),
    ("repeated", "repeated: it does not count"),
]
_OF_TIME = [("judged", "judged: by what was reached"), ("failure", "a failure of its checkpoint")]


class Migration(migrations.Migration):
    dependencies = [("plans", "0007_handout_code")]

    operations = [
        migrations.AddField(
            model_name="plan",
            name=name,
            field=models.CharField(
                verbose_name=called, max_length=8, choices=choices, default="judged", help_text=words
            ),
        )
        for name, called, choices, words in (
            ("on_estop", "an e-stop counts as", _ENDS, "Of a run that the e-stop ended."),
            (
                "on_interruption",
                "another interruption counts as",
                _ENDS,
                "Of a run that was broken off by anything else: a fault, a lost policy, a station that ended.",
            ),
            ("on_timeout", "a time-out counts as", _OF_TIME, "Of a run that its time limit ended."),
        )
    ]
