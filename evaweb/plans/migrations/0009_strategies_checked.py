"""Strategies of plans are checked when they are saved, and say whose they take the place of."""

from django.db import migrations, models

import evaweb.trials.tables


class Migration(migrations.Migration):
    dependencies = [("plans", "0008_counts_as"), ("trials", "0011_serving")]

    operations = [
        migrations.AlterField(
            model_name="plan",
            name="strategy",
            field=models.JSONField(
                null=True,
                blank=True,
                validators=[evaweb.trials.tables.check_strategy],
                help_text="Keys of the [strategy] table for all trials; empty: as each checkpoint or station has it.",
            ),
        ),
        migrations.AlterField(
            model_name="plan",
            name="comparing",
            field=models.CharField(
                verbose_name="comparisons",
                max_length=7,
                choices=[
                    ("pair", "first and second"),
                    ("control", "each checkpoint with the first"),
                    ("all", "all checkpoints with each other"),
                ],
                default="pair",
                help_text="What the question is about. Several share alpha.",
            ),
        ),
    ]
