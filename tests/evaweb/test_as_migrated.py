"""Every test begins with what migrations wrote, whatever the one before it left."""

import pytest
from django.contrib.auth.models import Group, Permission
from django.db import IntegrityError

from evaweb.accounts.roles import Role, role_of
from evaweb.stations.models import Station
from evaweb.trials.models import FailureTerm, Score
from tests.evaweb.as_migrated import AsMigrated
from tests.evaweb.trials import builders

with_transactions = pytest.mark.django_db(transaction=True)


@with_transactions
def test_all_is_gone_but_what_migrations_wrote_which_is_as_it_was():
    kept, before = AsMigrated(), sorted(Group.objects.values_list())
    bench = builders.bench()
    bench.scored(success=False)
    Group.objects.all().delete()
    Group.objects.create(name="another")
    FailureTerm.objects.update(order=0)
    Permission.objects.all().delete()
    kept.empty()
    assert kept.changed() == []
    assert sorted(Group.objects.values_list()) == before
    assert not Station.objects.exists()
    assert not Score.objects.exists()


@with_transactions
def test_what_the_database_refuses_to_remove_it_refuses_again_afterwards():
    kept = AsMigrated()
    builders.bench().scored(success=False)
    kept.empty()
    builders.bench().scored(success=False)
    with pytest.raises(IntegrityError, match="never"):
        Score.objects.update(success=True)


@with_transactions
@pytest.mark.parametrize("_again", range(2))
def test_after_a_test_with_transactions_there_are_the_groups(_again):
    assert set(Group.objects.values_list("name", flat=True)) == set(Role)
    assert role_of(builders.user("ann")) is Role.OPERATOR


@pytest.mark.django_db
@pytest.mark.parametrize("model", [Group, FailureTerm, Permission])
def test_a_test_that_leaves_other_rows_is_named_and_the_next_one_has_those_of_migrations(model):
    kept = AsMigrated()
    kept.check()
    model.objects.all().delete()
    with pytest.raises(pytest.fail.Exception, match=rf"left other rows.*{model._meta.db_table}"):
        kept.check()
    kept.check()


@pytest.mark.django_db
def test_rows_of_its_own_are_no_matter_of_this_check():
    kept = AsMigrated()
    builders.bench()
    kept.check()
