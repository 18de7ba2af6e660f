from django.db import migrations, models


class Migration(migrations.Migration):
    dependencies = [("episodes", "0009_away")]

    operations = [
        migrations.AddField(
            model_name="episode",
            name="archived_at",
            field=models.DateTimeField(
                blank=True,
                help_text="Since when its camera files are in the store; none: they are not.",
                null=True,
            ),
        ),
    ]
