from django.db import migrations, models


class Migration(migrations.Migration):
    dependencies = [
        ("results", "0002_judgements_kept"),
    ]

    operations = [
        migrations.AddField(
            model_name="rating",
            name="failure_phase",
            field=models.CharField(blank=True, default="", max_length=60),
            preserve_default=False,
        ),
    ]
