"""A checkpoint says what it is a training run of."""

from django.db import migrations, models

import evaweb.core.printed_names


class Migration(migrations.Migration):
    dependencies = [("trials", "0009_changed")]

    operations = [
        migrations.AddField(
            model_name="checkpoint",
            name="recipe",
            field=models.CharField(
                blank=True,
                default="",
                max_length=120,
                validators=[evaweb.core.printed_names.check_name],
                help_text="What it is a training run of: the same data and settings, another seed. Frozen with a plan, "
                "whose results sum up the runs of a recipe.",
            ),
            preserve_default=False,
        ),
    ]
