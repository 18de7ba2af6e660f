from django.db import migrations, models

from evaweb.records.append_only import triggers_suspended


class Migration(migrations.Migration):
    dependencies = [
        ("trials", "0011_serving"),
    ]

    operations = [
        migrations.AddField(
            model_name="trial",
            name="ended_by",
            field=models.CharField(
                blank=True,
                help_text="estop, interruption or timeout, as its run ended; empty where it ended by itself.",
                max_length=14,
                null=True,
            ),
        ),
        migrations.RunPython(migrations.RunPython.noop, triggers_suspended),  # backwards this comes first
    ]
