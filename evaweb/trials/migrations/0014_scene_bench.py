from django.db import migrations, models

import evaweb.trials.tables


class Migration(migrations.Migration):
    dependencies = [
        ("trials", "0013_training_set"),
    ]

    operations = [
        migrations.AddField(
            model_name="scene",
            name="bench",
            field=models.CharField(
                default="tabletop",
                help_text="Whose objects positions lay out: a bench that comes with the program, or its folder's path.",
                max_length=200,
                validators=[evaweb.trials.tables.check_bench_name],
                verbose_name="simulated bench",
            ),
        ),
    ]
