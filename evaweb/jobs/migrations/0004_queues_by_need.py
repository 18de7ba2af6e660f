"""Queues are named after what a worker needs; workers that run, the lab's data folder, and what jobs hold."""

import django.db.models.functions.datetime
from django.db import migrations, models

_NOT_CPU = {"judge": "gpu", "preflight": "station"}


def by_need(apps, schema_editor):
    """Jobs of before were all of the queue "lab"."""
    jobs = apps.get_model("jobs", "Job").objects
    jobs.exclude(kind__in=_NOT_CPU).update(queue="cpu")
    for kind, queue in _NOT_CPU.items():
        jobs.filter(kind=kind).update(queue=queue)


def one_queue(apps, schema_editor):
    apps.get_model("jobs", "Job").objects.update(queue="lab")


class Migration(migrations.Migration):
    dependencies = [
        ("jobs", "0003_cancelled"),
    ]

    operations = [
        migrations.AlterField(
            model_name="job",
            name="queue",
            field=models.CharField(default="cpu", help_text="What a worker needs for it.", max_length=63),
        ),
        migrations.RunPython(by_need, one_queue),
        migrations.CreateModel(
            name="WorkerProcess",
            fields=[
                (
                    "id",
                    models.UUIDField(
                        help_text="The owner that its jobs name.", primary_key=True, serialize=False
                    ),
                ),
                ("host", models.CharField(max_length=255)),
                ("queues", models.JSONField(default=list)),
                ("folder", models.BooleanField(help_text="Its data folder is the lab's.")),
                (
                    "seen_at",
                    models.DateTimeField(
                        db_default=django.db.models.functions.datetime.Now(),
                        help_text="Its last sign of life.",
                    ),
                ),
            ],
        ),
        migrations.CreateModel(
            name="LabFolder",
            fields=[
                (
                    "id",
                    models.BigAutoField(
                        auto_created=True, primary_key=True, serialize=False, verbose_name="ID"
                    ),
                ),
                ("lab_id", models.CharField(max_length=32)),
                ("host", models.CharField(max_length=255)),
                ("path", models.CharField(max_length=4096)),
            ],
            options={
                "constraints": [models.CheckConstraint(condition=models.Q(("id", 1)), name="one_lab_folder")],
            },
        ),
        migrations.CreateModel(
            name="Hold",
            fields=[
                (
                    "id",
                    models.BigAutoField(
                        auto_created=True, primary_key=True, serialize=False, verbose_name="ID"
                    ),
                ),
                ("what", models.CharField(max_length=1024, unique=True)),
                ("owner", models.UUIDField()),
                (
                    "job",
                    models.ForeignKey(on_delete=models.deletion.CASCADE, related_name="holds", to="jobs.job"),
                ),
            ],
        ),
    ]
