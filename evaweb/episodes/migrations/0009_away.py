from django.db import migrations, models


class Migration(migrations.Migration):
    dependencies = [("episodes", "0008_tags")]

    operations = [
        migrations.AddField(
            model_name="episode",
            name="away_since",
            field=models.DateTimeField(
                blank=True,
                help_text="Since when it is closed on its station's computer and not here yet; none: it is not on its way.",
                null=True,
            ),
        ),
    ]
