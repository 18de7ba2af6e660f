"""Schema of a simulated bench: its objects and what a layout may ask for, read from the bench's folder."""

from __future__ import annotations

import difflib
import hashlib
import itertools
import json
import math
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from runtime.core.errors import SetupError
from runtime.core.settings import Settings, explain_validation_error

FOLDER = Path(__file__).parent
FILE = "bench.toml"
DEFAULT_BENCH = "tabletop"
"""Bench of configurations, scenes and recordings that name none."""

Part = Annotated[int, Field(ge=0, le=255)]
Colour = Annotated[list[Part], Field(min_length=3, max_length=3)]
Length = Annotated[float, Field(gt=0, le=2)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,39}$")]
_NUMBERS = ("x", "y", "yaw in degrees")
_FARTHEST = 2.0  # [m] of an edge of the area from the middle
_LARGEST = 1e6  # absolute value of a number of a layout
_RANGES = {  # least and greatest value that a factor may be declared to have
    "light": (0.05, 5.0),
    "friction": (0.01, 10.0),
    "mass": (0.05, 100.0),
    "size": (0.2, 3.0),
    "hue": (-180.0, 180.0),
    "camera_x": (-0.3, 0.3),
    "camera_y": (-0.3, 0.3),
    "camera_z": (-0.3, 0.5),
    "distractors": (0.0, 20.0),
}


class UnusableBench(SetupError):
    """Error for a bench whose folder is absent, or whose file is invalid."""


class _Placed(Settings):
    title: Annotated[str, Field(min_length=1, max_length=40)]
    """What people call it."""
    colour: Colour
    example: Annotated[list[float], Field(min_length=2, max_length=3)]
    """Place in a new position: the numbers of `numbers`."""
    area: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None
    """Where a reset lays it out at random; None: in the area of the bench."""


class Box(_Placed):
    """Box that stands on the table."""

    shape: Literal["box"]
    size: Annotated[list[Annotated[float, Field(ge=0.005, le=0.3)]], Field(min_length=3, max_length=3)]
    """Edges along x, y and z at yaw 0 [m], all equal."""

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the numbers of a place: x, y [m] and yaw [degrees]."""
        return _NUMBERS


class Disc(_Placed):
    """Flat disc that lies on the table."""

    shape: Literal["disc"]
    radius: Length
    height: Length
    rim_colour: Colour

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the numbers of a place: x, y [m]; a disc has no yaw."""
        return _NUMBERS[:2]


class Apart(Settings):
    """Least distance between each two of `objects`, or between each of `objects` and each of `others` [m].

    Distances are from centre to centre.
    """

    objects: Annotated[list[Name], Field(min_length=1)]
    others: list[Name] = Field(default_factory=list)
    distance: Length

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Pairs of objects that have this least distance."""
        if self.others:
            return [(one, other) for one in self.objects for other in self.others]
        return list(itertools.combinations(self.objects, 2))


class Reach(Settings):
    """Places of arms, and the largest horizontal distance at which they grasp from above [m]."""

    sides: Annotated[list[Annotated[list[float], Field(min_length=2, max_length=2)]], Field(min_length=1)]
    distance: Length


class Distractors(Settings):
    """Further objects like the first box, placed at random: their colours, and their least distance from boxes [m]."""

    colours: list[Colour] = Field(default_factory=list)
    distance: Length = 0.1


FactorName = Literal[
    "light", "friction", "mass", "size", "hue", "camera_x", "camera_y", "camera_z", "distractors"
]


class Factor(Settings):
    """Factor of a bench that a position may change, with its bounds and the value that it has otherwise."""

    title: Annotated[str, Field(min_length=1, max_length=60)]
    usual: float
    low: float
    high: float


class Choice(Settings):
    """Choice that a position makes on a bench with a program of its own, such as the task."""

    title: Annotated[str, Field(min_length=1, max_length=60)]
    usual: Annotated[str, Field(min_length=1, max_length=80)]
    values: Annotated[
        list[Annotated[str, Field(min_length=1, max_length=80)]], Field(min_length=1, max_length=500)
    ]

    @model_validator(mode="after")
    def _has_its_usual(self) -> Choice:
        if self.usual not in self.values or len(set(self.values)) < len(self.values):
            raise SetupError(
                f"usual = {self.usual!r}, values = {self.values}; allowed: one of them, each once"
            )
        return self


class BenchProgram(Settings):
    """Program that simulates a bench in a process and a Python environment of its own."""

    file: Annotated[str, Field(pattern=r"^[A-Za-z0-9_]+\.py$")]
    """Python file in the bench's folder, with a function `make_bench`, see `runtime.benches.interface`."""
    requirements: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+\.txt$")] = "requirements.txt"
    """File in the folder with the packages of its environment, in pip's format."""
    observation: Annotated[int, Field(ge=0, le=10_000)] = 0
    """Numbers of its own observation vector; 0: it has none."""
    variables: dict[Annotated[str, Field(pattern=r"^[A-Z][A-Z0-9_]*$")], str] = Field(default_factory=dict)
    """Environment variables of the program."""
    content: Literal[""] | Annotated[str, Field(pattern="^[0-9a-f]{64}$")] = ""
    """Digest of the folder's Python files and requirements; computed when the bench is loaded."""


class Milestone(Settings):
    """What the bench reports, of an object or by itself."""

    text: Annotated[str, Field(min_length=1, max_length=120)]
    """What people read."""
    when: Literal["held", "lifted", "above", "rests", "reported"]
    """In a gripper; in one and clear of the table; the same above a disc; or at rest on a disc, released. `reported`:
    what a bench with a program of its own reports under this name."""
    object: Annotated[str, Field(max_length=40)] = ""
    on: str = ""
    """Disc, for `above` and `rests`."""

    @property
    def passes(self) -> bool:
        """Whether it stays reached once it was; `rests` is true only while the object rests there."""
        return self.when != "rests"


_GIVEN = ("area", "table_colour", "reach", "objects")  # what a bench without a program must declare
_OURS = (*_GIVEN, "apart", "distractors", "factors", "together")  # what one with a program cannot have


class BenchSchema(Settings):
    """What a bench consists of, and which layouts it accepts."""

    title: Annotated[str, Field(min_length=1, max_length=80)]
    instruction: str
    area: Annotated[list[float], Field(min_length=4, max_length=4)] = Field(
        default_factory=lambda: [-0.5, 0.5, 0.0, 0.5]
    )
    table_colour: Colour = Field(default_factory=lambda: [176, 164, 146])
    reach: Reach = Field(default_factory=lambda: Reach(sides=[[0.0, 0.0]], distance=1.0))
    objects: dict[Name, Annotated[Box | Disc, Field(discriminator="shape")]] = Field(default_factory=dict)
    apart: list[Apart] = Field(default_factory=list)
    distractors: Distractors = Distractors()
    factors: dict[FactorName, Factor] = Field(default_factory=dict)
    """light: brightness of the pictures, 1 as usual. friction, mass: times those of all surfaces, and of the blocks.
    size: times the edges of the blocks, whose density stays. hue: by how much the boxes' colours are turned on the
    colour wheel [degrees]. camera_x, camera_y, camera_z: by how much the overhead camera is moved [m]. distractors: how
    many."""
    together: list[Annotated[list[Name], Field(min_length=2)]] = Field(default_factory=list)
    """Objects that are placed so that one arm reaches all of them."""
    milestones: Annotated[dict[Name, Milestone], Field(min_length=1)]
    success: Annotated[list[Name], Field(min_length=1)]
    """Milestones of the kind `rests`, or `reported`, that together are the success of the task."""
    program: BenchProgram | None = None
    """Program that simulates this bench; absent: ours, with contact forces."""
    choices: Annotated[dict[Name, Choice], Field(max_length=20)] = Field(default_factory=dict)
    """What a position chooses on a bench with a program."""

    @model_validator(mode="after")
    def _is_consistent(self) -> BenchSchema:
        self._require_kind()
        if self.program is None:
            self._require_layout()
        return self

    def _require_kind(self) -> None:
        given = self.model_fields_set
        if self.program is None:
            if absent := [key for key in _GIVEN if key not in given]:
                raise SetupError(
                    f"{', '.join(absent)}: absent; needed by a bench without a program of its own"
                )
            if self.choices:
                raise SetupError("choices: only a bench with a program of its own has some; allowed: none")
            return
        if ours := [key for key in _OURS if key in given]:
            raise SetupError(f"{', '.join(ours)}: the bench's own program decides on these; allowed: none")
        for name, milestone in self.milestones.items():
            if milestone.when != "reported" or milestone.object or milestone.on:
                raise SetupError(
                    f'milestones.{name}.when = {milestone.when!r}; allowed: "reported", without object and on, because '
                    "the bench's own program reports it"
                )
        if strangers := [name for name in self.success if name not in self.milestones]:
            raise SetupError(f"success = {strangers}; allowed: {', '.join(self.milestones)}")

    def _require_layout(self) -> None:
        if not self.objects:
            raise SetupError("objects: none; allowed: one or more")
        x_from, x_to, y_from, y_to = self.area
        if not (x_from < x_to and y_from < y_to):
            raise SetupError(
                f"area = {self.area}; allowed: x from, x to, y from, y to, each range increasing"
            )
        for name in ("objects", "factors"):
            if name in self.objects:
                raise SetupError(
                    f"objects.{name}: layouts have this key for something else; allowed: another"
                )
        for name, factor in self.factors.items():
            low, high = _RANGES[name]
            if not low <= factor.low <= factor.high <= high:
                raise SetupError(
                    f"factors.{name}: low = {factor.low:g}, high = {factor.high:g}; allowed: {low:g} to {high:g}"
                )
            whole = name != "distractors" or factor.usual == int(factor.usual)
            if not (factor.low <= factor.usual <= factor.high and whole):
                number = "a whole number from " if name == "distractors" else ""
                raise SetupError(
                    f"factors.{name}.usual = {factor.usual:g}; allowed: {number}{factor.low:g} to {factor.high:g}"
                )
        self._require_objects()
        self._require_milestones()
        for pair in self.apart:
            named = [*pair.objects, *pair.others]
            if not pair.pairs or len(set(named)) < len(named) or not set(named) <= set(self.objects):
                raise SetupError(
                    f"apart.objects = {pair.objects}, others = {pair.others}; allowed: two or more of "
                    f"{', '.join(self.objects)}, each once"
                )
        if problem := next(self.problems({name: thing.example for name, thing in self.objects.items()}), ""):
            raise SetupError(f"the examples are no layout: {problem}")

    def _require_objects(self) -> None:
        x_from, x_to, y_from, y_to = self.area
        for name, thing in self.objects.items():
            if isinstance(thing, Box) and len(set(thing.size)) > 1:
                raise SetupError(f"objects.{name}.size = {thing.size}; allowed: a cube")
            if thing.area is None:
                continue
            x_low, x_high, y_low, y_high = thing.area
            if not (x_from <= x_low <= x_high <= x_to and y_from <= y_low <= y_high <= y_to):
                raise SetupError(
                    f"objects.{name}.area = {thing.area}; allowed: x from, x to, y from, y to, within the bench's "
                    f"{self.area}"
                )
        if not all(abs(edge) <= _FARTHEST for edge in self.area):
            raise SetupError(f"area = {self.area}; allowed: within {_FARTHEST:g} m of the middle")
        grouped = [name for names in self.together for name in names]
        if strangers := [name for name in grouped if name not in self.objects]:
            raise SetupError(f"together = {strangers}; allowed: names of {', '.join(self.objects)}")
        if len(set(grouped)) < len(grouped):
            raise SetupError(f"together = {self.together}; allowed: each object once")
        if (
            "distractors" in self.factors
            and self.factors["distractors"].high > 0
            and not self.distinct_colours
        ):
            raise SetupError(
                f"distractors.colours = {self.distractors.colours}; allowed: one or more that no box has, because "
                "distractors are like the first box otherwise"
            )

    @property
    def distinct_colours(self) -> list[list[int]]:
        """Colours of distractors that no box has: a distractor must not be taken for an object of the task."""
        used = [box.colour for box in self.boxes.values()]
        return [colour for colour in self.distractors.colours if colour not in used]

    def distractor_colour(self, number: int) -> list[int]:
        """Return the colour of a distractor, counted from 0; that of the first box if the schema has no other."""
        palette = self.distinct_colours or [next(iter(self.boxes.values())).colour]
        return palette[number % len(palette)]

    @property
    def digest(self) -> str:
        """Digest of everything that the schema declares; two benches with the same digest are the same bench.

        Keys that a bench without a program cannot have are left out, so that digests from before they existed hold.
        """
        without = {"program", "choices"} if self.program is None else set()
        content = json.dumps(
            self.model_dump(mode="json", exclude=without), sort_keys=True, separators=(",", ":")
        )
        return f"sha256:{hashlib.sha256(content.encode()).hexdigest()}"

    def _require_milestones(self) -> None:
        for name, milestone in self.milestones.items():
            if milestone.when == "reported":
                raise SetupError(
                    f'milestones.{name}.when = "reported"; allowed for a bench with a program of its own'
                )
            on_disc = milestone.when in ("above", "rests")
            fits = milestone.on in self.discs if on_disc else not milestone.on
            if milestone.object not in self.boxes or not fits:
                raise SetupError(
                    f"milestones.{name}: object = {milestone.object!r}, on = {milestone.on!r}; allowed: object one of "
                    f"{', '.join(self.boxes)}; on "
                    + (
                        f"one of {', '.join(self.discs) or 'no disc'}"
                        if on_disc
                        else f"none if when = {milestone.when!r}"
                    )
                )
        resting = [name for name, milestone in self.milestones.items() if milestone.when == "rests"]
        if strangers := [name for name in self.success if name not in resting]:
            raise SetupError(f"success = {strangers}; allowed: {', '.join(resting) or 'no milestone rests'}")

    @property
    def boxes(self) -> dict[str, Box]:
        """Boxes by name, in the order of the file."""
        return {name: thing for name, thing in self.objects.items() if isinstance(thing, Box)}

    @property
    def discs(self) -> dict[str, Disc]:
        """Discs by name, in the order of the file."""
        return {name: thing for name, thing in self.objects.items() if isinstance(thing, Disc)}

    def box(self, name: str) -> Box:
        """Return the box of that name. Raises: SetupError if there is none."""
        thing = self.objects.get(name)
        if not isinstance(thing, Box):
            raise SetupError(f"the bench {self.title!r} has no box {name!r}")
        return thing

    def disc(self, name: str) -> Disc:
        """Return the disc of that name. Raises: SetupError if there is none."""
        thing = self.objects.get(name)
        if not isinstance(thing, Disc):
            raise SetupError(f"the bench {self.title!r} has no disc {name!r}")
        return thing

    def distance(self, one: str, other: str) -> float:
        """Return the least distance of two objects [m], 0 if none is declared."""
        return next((least for *pair, least in self.distances if {one, other} == set(pair)), 0.0)

    @property
    def distances(self) -> list[tuple[str, str, float]]:
        """Pairs of objects with their least distances [m]."""
        return [(*names, pair.distance) for pair in self.apart for names in pair.pairs]

    def problems(self, layout: Mapping[str, Any]) -> Iterator[str]:
        """Yield a sentence for each place of `layout` (name -> numbers) that the bench does not accept.

        A layout may leave objects out; they are then placed at random.
        """
        placed = {}
        for name, place in layout.items():
            problem = self._place_problem(name, place)
            if problem:
                yield problem
            else:
                placed[name] = place
        for one, other, least in self.distances:
            if one in placed and other in placed:
                apart = math.dist(placed[one][:2], placed[other][:2])
                if apart < least:
                    yield f"{one} and {other} are {1000 * apart:.0f} mm apart; allowed: {1000 * least:.0f} mm or more"

    def factor_problems(self, factors: Mapping[str, Any]) -> Iterator[str]:
        """Yield a sentence for each of `factors` (name -> value) that the bench does not have, or not so."""
        for name, value in factors.items():
            factor = self.factors.get(name)  # type: ignore[call-overload]
            if factor is None:
                yield f"factors.{name}: unknown factor; allowed: {', '.join(self.factors) or 'none'}"
                continue
            whole = name == "distractors"
            if not is_place([value], 1) or not factor.low <= value <= factor.high or (whole and value % 1):
                number = "a whole number" if whole else "a number"
                yield f"factors.{name} = {value!r:.40}; allowed: {number} from {factor.low:g} to {factor.high:g}"

    def choice_problems(self, choices: Mapping[str, Any]) -> Iterator[str]:
        """Yield a sentence for each of `choices` (name -> value) that the bench does not have, or not so."""
        for name, value in choices.items():
            choice = self.choices.get(name)
            if choice is None:
                yield f"choices.{name}: unknown choice; allowed: {', '.join(self.choices) or 'none'}"
            elif value not in choice.values:
                near = difflib.get_close_matches(str(value), choice.values, n=5) or choice.values
                more = f" and {len(choice.values) - len(near)} more" if len(near) < len(choice.values) else ""
                yield f"choices.{name} = {value!r:.80}; allowed: {', '.join(near)}{more}"

    def factor_values(self, factors: Mapping[str, float]) -> dict[str, float]:
        """Return the value of every factor: that of `factors`, or the usual one."""
        return {name: float(factors.get(name, factor.usual)) for name, factor in self.factors.items()}

    def _place_problem(self, name: str, place: Any) -> str:
        thing = self.objects.get(name)
        if thing is None:
            return f"{name}: unknown object; allowed: {', '.join(self.objects)}"
        if not is_place(place, len(thing.numbers)):
            parts = ", ".join(thing.numbers)
            return (
                f"{name} = {place!r:.80}; allowed: {len(thing.numbers)} finite numbers: [{parts}], in metres"
            )
        x_from, x_to, y_from, y_to = self.area
        x, y = place[:2]
        if x_from <= x <= x_to and y_from <= y <= y_to:
            return ""
        return (
            f"{name} at x {1000 * x:.0f}, y {1000 * y:.0f} mm; allowed on a simulated bench: "
            f"x {1000 * x_from:.0f} to {1000 * x_to:.0f}, y {1000 * y_from:.0f} to {1000 * y_to:.0f} mm"
        )


def is_place(value: Any, count: int) -> bool:
    """Return True for a list or tuple of `count` finite numbers, none of which is huge."""
    return (
        isinstance(value, list | tuple)
        and len(value) == count
        and all(
            isinstance(part, int | float)
            and not isinstance(part, bool)
            and abs(part) < _LARGEST  # False for NaN; an int of any size can be compared
            for part in value
        )
    )


def installed_benches() -> list[str]:
    """Return the names of the benches that come with the program, sorted."""
    return sorted(file.parent.name for file in FOLDER.glob(f"*/{FILE}"))


def bench_folder(bench: str) -> Path:
    """Return the folder of a bench: of one that comes with the program by name, else its path."""
    return FOLDER / bench if bench in installed_benches() else Path(bench).expanduser()


def _digest_program(folder: Path, program: BenchProgram) -> str:
    """Return the digest of a program's Python files, also those of packages in its folder, and requirements.

    Raises:
        SetupError: If its file or its requirements are absent.
    """
    for name in (program.file, program.requirements):
        if not (folder / name).is_file():
            raise SetupError(f"program: {name} is not in {folder}; allowed: a file of the bench's folder")
    digest = hashlib.sha256()
    for file in sorted({*folder.rglob("*.py"), folder / program.requirements}):
        for part in (file.relative_to(folder).as_posix().encode(), file.read_bytes()):
            digest.update(len(part).to_bytes(8, "big") + part)
    return digest.hexdigest()


@cache  # cache: a bench stays the same while this runs; an integrator who edits it starts the station anew
def load_schema(bench: str) -> BenchSchema:
    """Return the schema of a bench: the name of one that comes with the program, or the path of its folder.

    Raises:
        UnusableBench: If there is none, or its file is invalid.
    """
    file = Path(bench, FILE)
    try:
        file = bench_folder(bench) / FILE
        tree = tomllib.loads(file.read_text(encoding="utf-8"))
        schema = BenchSchema.model_validate(tree)
        if schema.program is None:
            return schema
        content = _digest_program(file.parent, schema.program)
        return schema.model_copy(update={"program": schema.program.model_copy(update={"content": content})})
    except FileNotFoundError:
        raise UnusableBench(
            f"bench {bench!r} has no {FILE}; allowed: {', '.join(installed_benches())}, or the path of a bench's folder"
        ) from None
    except SetupError as error:
        raise UnusableBench(f"{file}: {error}") from error
    except ValidationError as invalid:
        raise UnusableBench(explain_validation_error(invalid, BenchSchema, tree, str(file))) from invalid
    except (
        OSError,
        RuntimeError,
        ValueError,
    ) as error:  # no such home, nested too deeply, no UTF-8, no TOML, a NUL
        raise UnusableBench(f"{str(file)!r:.300}: {error}") from error
