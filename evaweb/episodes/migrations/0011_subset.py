import django.core.validators
import django.db.models.deletion
import django.utils.timezone
from django.conf import settings
from django.db import migrations, models


class Migration(migrations.Migration):
    dependencies = [
        ("episodes", "0010_archived"),
        migrations.swappable_dependency(settings.AUTH_USER_MODEL),
    ]

    operations = [
        migrations.CreateModel(
            name="Subset",
            fields=[
                (
                    "id",
                    models.BigAutoField(
                        auto_created=True, primary_key=True, serialize=False, verbose_name="ID"
                    ),
                ),
                (
                    "name",
                    models.CharField(
                        help_text="Also that of its dataset.",
                        max_length=100,
                        unique=True,
                        validators=[
                            django.core.validators.RegexValidator(
                                "\\A[A-Za-z0-9][A-Za-z0-9_.-]{0,99}\\Z",
                                "%(value)s was given; allowed: letters, digits, '.', '_' and '-', the first a letter "
                                "or digit",
                            )
                        ],
                    ),
                ),
                ("description", models.TextField(blank=True, help_text="What it is for.")),
                (
                    "query",
                    models.JSONField(blank=True, default=dict, help_text="Filters of the list of episodes."),
                ),
                (
                    "digest",
                    models.CharField(help_text="SHA-256 of the sorted UUIDs of its episodes.", max_length=64),
                ),
                ("created_at", models.DateTimeField(default=django.utils.timezone.now)),
                (
                    "dataset",
                    models.CharField(blank=True, help_text="Relative to the data folder.", max_length=240),
                ),
                ("published_at", models.DateTimeField(blank=True, null=True)),
                (
                    "created_by",
                    models.ForeignKey(
                        on_delete=django.db.models.deletion.PROTECT,
                        related_name="subsets",
                        to=settings.AUTH_USER_MODEL,
                    ),
                ),
                ("episodes", models.ManyToManyField(related_name="subsets", to="episodes.episode")),
            ],
            options={"ordering": ("-created_at",)},
        ),
    ]
