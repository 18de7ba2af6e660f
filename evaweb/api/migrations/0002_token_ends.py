from datetime import timedelta

from django.db import migrations, models
from django.utils import timezone


def ninety_days_from_now():
    """Tokens that had no end get one, from the day of the update."""
    return timezone.now() + timedelta(days=90)


class Migration(migrations.Migration):
    dependencies = [("api", "0001_initial")]

    operations = [
        migrations.AddField(
            model_name="token",
            name="ends_at",
            field=models.DateTimeField(default=ninety_days_from_now, editable=False),
            preserve_default=False,
        ),
    ]
