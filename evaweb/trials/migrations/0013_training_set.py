import django.db.models.deletion
from django.db import migrations, models


class Migration(migrations.Migration):
    dependencies = [("episodes", "0011_subset"), ("trials", "0012_ended_by")]

    operations = [
        migrations.AddField(
            model_name="checkpoint",
            name="training_set",
            field=models.ForeignKey(
                blank=True,
                help_text="The subset of this lab's episodes that it was trained on.",
                null=True,
                on_delete=django.db.models.deletion.PROTECT,
                related_name="checkpoints",
                to="episodes.subset",
                verbose_name="training set",
            ),
        ),
    ]
