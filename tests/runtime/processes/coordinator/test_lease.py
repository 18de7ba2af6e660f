import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.processes.coordinator.lease import HIGHEST_EPOCH, Lease

TTL = 5.0
ACTS = st.tuples(
    st.sampled_from(["claim", "renew", "release", "check"]),
    st.sampled_from(["anna", "ben", "carla"]),
    st.integers(-1, 8),
    st.floats(0.0, 4.0),
)


@pytest.fixture
def lease():
    return Lease(TTL)


def test_a_free_lease_goes_to_whoever_claims_it(lease):
    assert lease.claim("anna", 0, 10.0) == ""
    held = lease.current(10.0)
    assert (held.holder, held.epoch, held.until) == ("anna", 1, 15.0)


def test_a_terminal_never_takes_somebodys_lease(lease):
    lease.claim("anna", 0, 10.0)
    assert lease.claim("ben", 0, 12.0) == "anna holds the lease for another 3.0 s"
    assert lease.current(12.0).holder == "anna"


def test_a_higher_epoch_takes_over_and_the_former_holder_is_refused(lease):
    lease.claim("anna", 3, 10.0)
    assert lease.claim("ben", 4, 11.0) == ""
    assert lease.check("anna", 3, 11.0) == "ben holds the lease"
    assert lease.renew("anna", 3, 11.0) == "ben holds the lease"
    assert lease.check("ben", 4, 11.0) == ""


def test_a_lower_epoch_is_refused(lease):
    lease.claim("anna", 3, 10.0)
    assert lease.claim("ben", 2, 11.0) == "epoch 2 is over, the lease is in epoch 3"


def test_an_epoch_does_not_come_again_after_its_lease_has_ended(lease):
    lease.claim("anna", 3, 10.0)
    assert lease.claim("ben", 3, 100.0) == "epoch 3 is over, the lease is in epoch 3"
    assert lease.claim("anna", 3, 100.0) == "epoch 3 is over, the lease is in epoch 3"


def test_claiming_again_keeps_the_lease_in_its_epoch(lease):
    lease.claim("anna", 0, 10.0)
    assert lease.claim("anna", 0, 14.0) == ""
    assert (lease.current(14.0).epoch, lease.current(14.0).until) == (1, 19.0)


def test_silence_ends_it(lease):
    lease.claim("anna", 0, 10.0)
    assert lease.current(14.999) is not None
    assert lease.current(15.0) is None
    assert lease.check("anna", 1, 15.0) == "the station has no operator: take it first"


def test_a_lease_that_has_ended_cannot_be_renewed(lease):
    lease.claim("anna", 0, 10.0)
    assert lease.renew("anna", 1, 15.0) == "the station has no operator: take it first"
    assert lease.current(15.0) is None


def test_renewing_extends_it(lease):
    lease.claim("anna", 0, 10.0)
    assert lease.renew("anna", 1, 14.0) == ""
    assert lease.current(18.0).holder == "anna"


def test_only_the_holder_gives_it_up(lease):
    lease.claim("anna", 0, 10.0)
    assert lease.release("ben", 1, 11.0) == "anna holds the lease"
    assert lease.release("anna", 1, 11.0) == ""
    assert lease.current(11.0) is None


def test_the_holder_with_a_wrong_epoch_is_refused(lease):
    lease.claim("anna", 7, 10.0)
    assert lease.check("anna", 6, 10.0) == "epoch 6 is not the lease's epoch 7"


def test_nobody_is_no_holder(lease):
    assert lease.claim("", 0, 10.0) == "a lease needs the name of its holder"
    assert lease.current(10.0) is None


@pytest.mark.parametrize("epoch", [-1, HIGHEST_EPOCH + 1, 2**64])
def test_an_impossible_epoch_is_refused(lease, epoch):
    assert "impossible" in lease.claim("anna", epoch, 10.0)
    assert lease.epoch == 0


def test_a_terminal_can_claim_after_the_highest_epoch(lease):
    lease.claim("anna", HIGHEST_EPOCH, 10.0)
    assert lease.claim("ben", 0, 20.0) == ""
    assert lease.epoch == HIGHEST_EPOCH + 1


def test_epochs_of_before_a_restart_are_over(lease):
    lease.raise_epoch_floor(9)
    assert lease.claim("anna", 9, 10.0) == "epoch 9 is over, the lease is in epoch 9"
    assert lease.claim("anna", 0, 10.0) == ""
    assert lease.epoch == 10
    lease.raise_epoch_floor(3)
    assert lease.epoch == 10


@given(st.lists(ACTS, max_size=60))
def test_there_is_one_holder_at_most_and_epochs_never_go_back(acts):
    lease, now, granted = Lease(TTL), 0.0, {}
    for act, holder, epoch, wait in acts:
        now += wait
        before, newest = lease.current(now), lease.epoch
        refusal = getattr(lease, act)(holder, epoch, now)
        after = lease.current(now)
        assert lease.epoch >= newest
        if refusal or act == "check":
            assert after == before
        if after is not None:
            assert after.epoch == lease.epoch
            # An epoch belongs to one holder for ever.
            assert granted.setdefault(after.epoch, after.holder) == after.holder
            may = [h for h in ("anna", "ben", "carla") if not lease.check(h, after.epoch, now)]
            assert may == [after.holder]
        else:
            assert all(lease.check(h, lease.epoch, now) for h in ("anna", "ben", "carla"))


@given(st.lists(ACTS, max_size=40))
def test_who_holds_it_keeps_it_until_it_ends_unless_a_higher_epoch_or_its_own_word_ends_it(acts):
    lease, now = Lease(TTL), 0.0
    for act, holder, epoch, wait in acts:
        now += wait
        before = lease.current(now)
        getattr(lease, act)(holder, epoch, now)
        after = lease.current(now)
        if before is None or (after and after.holder == before.holder):
            continue
        gave_up = act == "release" and (holder, epoch) == (before.holder, before.epoch)
        taken = act == "claim" and epoch > before.epoch
        assert gave_up or taken


def test_a_lease_is_lost_only_by_silence(lease):
    assert not lease.lost(10.0)
    lease.claim("anna", 0, 10.0)
    assert not lease.lost(14.9)
    assert lease.lost(15.0)
    lease.claim("anna", 0, 20.0)
    lease.release("anna", 2, 21.0)
    assert not lease.lost(30.0)


def test_a_lease_whose_page_was_hidden_last_is_not_lost(lease):
    lease.claim("anna", 0, 10.0)
    lease.hide("ben", 1, 11.0)
    assert lease.lost(15.0)
    lease.claim("anna", 0, 20.0)
    lease.hide("anna", 2, 21.0)
    assert not lease.lost(25.0)
    lease.claim("anna", 0, 30.0)
    lease.hide("anna", 3, 31.0)
    lease.renew("anna", 3, 32.0)
    assert lease.lost(37.0)
