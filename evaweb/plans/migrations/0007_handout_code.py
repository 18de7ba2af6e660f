"""A trial is found by its code."""

from django.db import migrations, models


class Migration(migrations.Migration):
    dependencies = [("plans", "0006_names")]

    operations = [
        migrations.AddIndex(model_name="handout", index=models.Index(fields=["code"], name="handout_code")),
    ]
