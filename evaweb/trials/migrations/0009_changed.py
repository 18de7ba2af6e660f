"""The trials that were changed last are found by an index."""

from django.db import migrations, models


class Migration(migrations.Migration):
    dependencies = [
        ("trials", "0008_names"),
    ]

    operations = [
        migrations.AddIndex(
            model_name="trial",
            index=models.Index(fields=["-changed_at", "-id"], name="trial_changed"),
        ),
    ]
