"""Orders for operations on datasets: validated here, executed by a worker as jobs of one kind."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StrictBool, TypeAdapter, ValidationError

import robots
from evaweb.accounts.hub_tokens import choose_hub_account
from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import Conflict, EvaError
from evaweb.datasets.bags import find_bag, read_mapping_text, require_robot
from evaweb.datasets.overview import dataset_names, folder_named, get_dataset_folder
from evaweb.episodes.subsets import subset_datasets, subset_get
from evaweb.jobs.kinds import ORDERED_BY
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.services import enqueue
from runtime.core.sentences import Pattern
from runtime.datasets.card import Licence
from runtime.datasets.layout import INFO
from runtime.datasets.operations import fingerprint
from runtime.interop.mcap_export import Pictures
from runtime.recording.files import RecordingError

_ROBOT_ALLOWED_NONE = Pattern(
    "datasets.orders.robot_allowed_none",
    "robot = {robot!r}; allowed: {names}, or none",
)
_WOULD_LIE_WITHIN_DATASET_CHOOSE = Pattern(
    "datasets.orders.would_lie_within_dataset_choose",
    "{wanted} would lie within the dataset {name}: choose another name",
)
_THERE_ALREADY_NOT_EMPTY_CHOOSE = Pattern(
    "datasets.orders.there_already_not_empty_choose",
    "{wanted} is there already and not empty: choose another name",
)
_EPISODES_BEING_DELETED_WAIT_UNTIL = Pattern(
    "datasets.orders.episodes_being_deleted_wait_until",
    "episodes of {dataset} are being deleted: wait until that is done",
)

KIND = "dataset"
Name = Annotated[str, Field(min_length=1, max_length=200)]
BagName = Annotated[str, Field(min_length=1, max_length=600)]
Index = Annotated[int, Field(ge=0, lt=2**31)]
Version = Literal["v2.1", "v3.0"]


class _Order(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Check(_Order):
    """Order to compare a dataset with its own metadata."""

    what: Literal["check"]
    dataset: Name


class Repair(_Order):
    """Order to undo what a crash left incomplete in a dataset."""

    what: Literal["repair"]
    dataset: Name


class Convert(_Order):
    """Order to write a copy of a dataset in another version of the format; features may get new names."""

    what: Literal["convert"]
    dataset: Name
    to: Name
    version: Version
    rename: dict[Name, Name] = Field(default_factory=dict, max_length=100)
    reencode: StrictBool = False


class Import(_Order):
    """Order to import a dataset's episodes, so that they can be checked, reviewed and annotated here.

    `robot` is the robot to whose values the dataset's columns belong.
    """

    what: Literal["import"]
    dataset: Name
    robot: Annotated[str, Field(max_length=63)] = ""
    state: Annotated[str, Field(max_length=200)] = ""


class Merge(_Order):
    """Order to write the episodes of several datasets, in this order, as a new one."""

    what: Literal["merge"]
    datasets: Annotated[list[Name], Field(min_length=2, max_length=100)]
    to: Name
    version: Version | None = None
    reencode: StrictBool = False


class Split(_Order):
    """Order to write some episodes of a dataset as new datasets below the folder `to`."""

    what: Literal["split"]
    dataset: Name
    to: Name
    parts: Annotated[dict[Name, list[Index]], Field(min_length=1, max_length=100)]
    version: Version | None = None
    reencode: StrictBool = False


class Delete(_Order):
    """Order to delete episodes from a dataset; later episodes get lower indices. Requires an administrator."""

    what: Literal["delete"]
    dataset: Name
    episodes: Annotated[list[Index], Field(min_length=1)]
    reencode: StrictBool = False


class Push(_Order):
    """Order to upload a dataset to the Hugging Face hub. Requires an administrator.

    It uses the Hugging Face token that the user has stored under Your account, else the lab's account.
    """

    what: Literal["push"]
    dataset: Name
    repository: Name
    private: StrictBool = True
    licence: Licence = ""


class Pull(_Order):
    """Order to download a dataset from the Hugging Face hub as a new one. Requires an administrator.

    It uses the Hugging Face token that the user has stored under Your account, else the lab's account.
    """

    what: Literal["pull"]
    repository: Name
    to: Name
    revision: Annotated[str, Field(max_length=200)] = ""


class Mcap(_Order):
    """Order to write every episode of a dataset that was recorded here as one MCAP file, which is kept for a day."""

    what: Literal["mcap"]
    dataset: Name
    pictures: Pictures = "video"


class Propose(_Order):
    """Order to propose a mapping of a bag's topics to a robot."""

    what: Literal["propose"]
    bag: BagName
    robot: Annotated[str, Field(min_length=1, max_length=63)]


class Bags(_Order):
    """Order to add bags as episodes to a dataset, which is created if it does not exist, by a saved mapping."""

    what: Literal["import_bags"]
    bags: Annotated[list[BagName], Field(min_length=1, max_length=1000)]
    mapping: Name
    to: Name


class PublishSubset(_Order):
    """Order to write the episodes of a named subset as a new dataset of its name."""

    what: Literal["subset"]
    subset: Annotated[str, Field(min_length=1, max_length=100)]
    version: Version | None = None
    reencode: StrictBool = False


AnyOrder = (
    Check
    | Repair
    | Convert
    | Import
    | Merge
    | Split
    | Delete
    | Push
    | Pull
    | Mcap
    | Propose
    | Bags
    | PublishSubset
)
Order = Annotated[AnyOrder, Field(discriminator="what")]
_ADAPTER: TypeAdapter[AnyOrder] = TypeAdapter(Order)
_OF_ADMINS = ("delete", "push", "pull")


def least_for(what: str) -> Role:
    """Return the lowest role that may submit this order."""
    return Role.ADMIN if what in _OF_ADMINS else Role.OPERATOR


def parse_order(given: Mapping[str, Any]) -> Any:
    """Return the validated order. Raises: EvaError with the first problem."""
    try:
        return _ADAPTER.validate_python(dict(given))
    except ValidationError as invalid:
        error = invalid.errors(include_url=False)[0]
        place = ".".join(str(part) for part in error["loc"] if part != given.get("what")) or "what"
        raise EvaError(f"{place}: {error['msg']}; given: {error.get('input')!r:.120}") from None


def full_name(given: str) -> str:
    """Return the full name of a dataset, whose usual folder may be omitted: cups is datasets/cups if that exists."""
    usual = f"datasets/{given}"
    names = dataset_names()
    return usual if usual in names or (given not in names and "/" not in given) else given


def submit_order(*, user: Any, given: Mapping[str, Any]) -> Job:
    """Queue an order; deleting and pushing need an administrator, other orders an operator.

    Raises: EvaError if a source does not exist, a target exists, or a name is outside the data folder.
    """
    order = parse_order(given)
    require_role(user, least_for(order.what))
    sources = _sources(order)
    names = [full_name(name) for name in sources]
    for name in names:
        get_dataset_folder(name)
    args = order.model_dump()
    if isinstance(order, Merge):
        args["datasets"] = names
    elif names:
        args["dataset"] = names[0]
    if isinstance(order, Convert | Merge | Split | Pull):
        args["to"] = _new(order.to, order.parts if isinstance(order, Split) else ())
    if isinstance(order, Propose):
        find_bag(order.bag)
        require_robot(order.robot)
    if isinstance(order, Bags):
        args |= _bag_args(order)
    if isinstance(order, PublishSubset):
        args |= _subset_args(order)
    if isinstance(order, Delete):
        args |= {"episodes": sorted(set(order.episodes)), "known": _known(names[0])}
    if isinstance(order, Push | Pull):
        args |= {ORDERED_BY: user.pk, "account": choose_hub_account(user).value}
    if isinstance(order, Import) and order.robot and not robots.is_described(order.robot):
        raise EvaError(_ROBOT_ALLOWED_NONE(robot=order.robot, names=", ".join(robots.robot_names())))
    _require_no_deletion(names)
    about = next(filter(None, [*names, args.get("to"), args.get("bag")]))
    return enqueue(kind=KIND, key=key_of(order.what, about, args), args=args)


def _sources(order: AnyOrder) -> list[str]:
    """Return the names of the datasets that an order reads, as they were given."""
    if isinstance(order, Pull | Propose | Bags | PublishSubset):
        return []
    return list(order.datasets) if isinstance(order, Merge) else [order.dataset]


def key_of(what: str, name: str, args: Mapping[str, Any]) -> str:
    """Return the key of the job that carries out an order; jobs with the same key exclude each other.

    For a check or a repair the key depends only on the dataset, so that each dataset has at most one such job at a
    time. The keys of other orders also depend on their arguments.
    """
    if what in ("check", "repair"):
        return f"dataset:{what}:{_short(name)}"
    suffix = hashlib.sha256(json.dumps(dict(args), sort_keys=True).encode()).hexdigest()[:12]
    return f"dataset:{what}:{_short(name)}:{suffix}"


def _short(name: str) -> str:
    return name if len(name) <= 100 else f"{name[:80]}-{hashlib.sha256(name.encode()).hexdigest()[:12]}"


def _new(to: str, parts: Sequence[str] | Mapping[str, Any]) -> str:
    """Return the full name of a new dataset. Raises: Conflict if it exists or is inside another dataset."""
    name = to if "/" in to else f"datasets/{to}"
    for path in [f"{name}/{part}" for part in parts] or [name]:
        folder = folder_named(path)
        around = next((above for above in folder.parents if (above / INFO).is_file()), None)
        if around is not None:
            raise Conflict(_WOULD_LIE_WITHIN_DATASET_CHOOSE(wanted=path, name=around.name))
        if folder.exists() and any(folder.iterdir()):
            raise Conflict(_THERE_ALREADY_NOT_EMPTY_CHOOSE(wanted=path))
    return name


def _bag_args(order: Bags) -> dict[str, Any]:
    """Return the arguments of an import of bags: each bag once, the full name of its dataset, and the mapping as it is
    now.
    """
    bags = list(dict.fromkeys(order.bags))
    for bag in bags:
        find_bag(bag)
    name = full_name(order.to)
    if name not in dataset_names():
        name = _new(order.to, ())
    return {"bags": bags, "to": name, "content": read_mapping_text(order.mapping)}


def _subset_args(order: PublishSubset) -> dict[str, Any]:
    """Return the arguments of the publication of a subset: the datasets that have its episodes, and the new one."""
    subset = subset_get(name=order.subset)
    return {"datasets": subset_datasets(subset=subset), "to": _new(subset.name, ())}


def _known(name: str) -> str:
    try:
        return fingerprint(get_dataset_folder(name))
    except RecordingError as fault:
        raise Conflict(str(fault)) from None


def _require_no_deletion(names: Sequence[str]) -> None:
    """Raise Conflict during a deletion, which changes the episode indices that a waiting order refers to."""
    for job in Job.objects.filter(
        kind=KIND, status__in=(JobStatus.QUEUED, JobStatus.RUNNING), args__what="delete"
    ):
        if job.args.get("dataset") in names:
            raise Conflict(_EPISODES_BEING_DELETED_WAIT_UNTIL(dataset=job.args["dataset"]))
