"""A checkpoint says which strategy its trials run with, and whether it is an anchor."""

from django.db import migrations, models

import evaweb.trials.tables


class Migration(migrations.Migration):
    dependencies = [("trials", "0010_recipe")]

    operations = [
        migrations.AddField(
            model_name="checkpoint",
            name="strategy",
            field=models.JSONField(
                null=True,
                blank=True,
                validators=[evaweb.trials.tables.check_strategy],
                help_text="Keys of the [strategy] table that its trials run with; empty: as plan or station have it. "
                "The same weights served in several ways are a checkpoint each, with the same digest.",
            ),
        ),
        migrations.AddField(
            model_name="checkpoint",
            name="anchor",
            field=models.BooleanField(
                default=False,
                help_text="Tried beside others in plan after plan, so that it shows when a bench or its scoring drifts: "
                "compared with none but where a plan names it. Frozen with a plan.",
            ),
        ),
    ]
