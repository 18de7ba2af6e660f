"""`manage.py benchmark NAME`: a lab with a published benchmark's tasks, and its scripted experts as policy servers."""

from __future__ import annotations

import os
from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from django.conf import settings
from django.core.management.base import BaseCommand, CommandError

from evaweb.accounts.roles import Role
from evaweb.core.errors import EvaError
from evaweb.lab import demo_rows, programs
from evaweb.lab.benches import Bench
from evaweb.lab.lab import Lab, open_lab
from evaweb.lab.lifetime import StopRequested
from evaweb.lab.progress import on_terminal
from evaweb.lab.simulated import benches_of, known_port
from evaweb.plans.models import Plan, StoppingRule
from evaweb.trials.models import Checkpoint, Scene
from runtime.benches.environments import UnusableEnvironment, make_environment
from runtime.benches.schema import load_schema


class Benchmark(NamedTuple):
    """A benchmark that is a bench with a program of its own, and a deployment of the same name.

    Attributes:
        title: Its name for people.
        size: What the first start installs.
        experts: Whose experts they are.
        instructions: By task; a task that is not here is its own instruction.
        noise: One sigma, added to each number of the noisy experts' rows.
        compared: Tasks of the plan.
        time_limit_s: More than the benchmark's own last step.
    """

    title: str
    size: str
    experts: str
    instructions: Mapping[str, str]
    noise: float
    compared: tuple[str, ...]
    time_limit_s: float


_BENCHMARKS = {
    "metaworld": Benchmark(
        title="Meta-World",
        size="250 MB",
        experts="Meta-World's scripted experts, each for its own task",
        instructions={},
        noise=1.0,
        compared=(
            *("reach-v3", "push-v3", "pick-place-v3", "door-open-v3", "drawer-open-v3"),
            *(
                "drawer-close-v3",
                "button-press-topdown-v3",
                "peg-insert-side-v3",
                "window-open-v3",
                "window-close-v3",
            ),
        ),
        time_limit_s=10.0,
    ),
    "aloha": Benchmark(
        title="gym-aloha",
        size="650 MB",
        experts="Scripted experts of gym-aloha's tasks, which come with EVA Web",
        instructions={
            "transfer_cube": "Pick up the cube with the right arm and transfer it to the left arm.",
            "insertion": "Insert the peg into the socket.",
        },
        noise=0.02,
        compared=("transfer_cube", "insertion"),
        time_limit_s=10.0,
    ),
}
_REPETITIONS = 5
_STEPS = 4  # progress steps besides those of any lab: environment, tasks, experts, plan


class Command(BaseCommand):
    """Command that runs a lab with a published benchmark until Ctrl-C."""

    help = "A lab on this machine with a published benchmark: tasks as scenes, experts as checkpoints, a blind plan."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument("name", choices=_BENCHMARKS, help="the benchmark")
        parser.add_argument("--host", default="127.0.0.1", help="address that the web listens on")
        parser.add_argument("--port", type=int, default=8000, help="port of the web; 0 takes a free one")
        parser.add_argument(
            "--stop-port", type=int, help="port of the process for stops; the one after that of the web"
        )
        parser.add_argument(
            "--pictures", type=int, default=224, metavar="PIXELS", help="width and height of pictures"
        )

    def handle(self, *args: Any, **options: Any) -> None:
        progress = on_terminal(Lab.STEPS + 1 + _STEPS)
        size = options["pictures"]
        if not 16 <= size <= 1024:
            raise CommandError(f"--pictures {size}: allowed: 16 to 1024")
        try:
            bench = options["name"]
            told = _BENCHMARKS[bench]
            with progress.step(f"the environment of {told.title}, once: some {told.size}"):
                os.environ["EVA_DATA_DIR"] = str(settings.DATA_DIR)  # as for the programs of the lab
                make_environment(bench)
            with open_lab(options["host"], options["port"], options["stop_port"], progress) as lab:
                self._up(lab, bench, (size, size))
                lab.watch(benches_of({"pictures": (size, size), "set": []}))
        except StopRequested:
            self.stdout.write("ended; the data stays in " + str(settings.DATA_DIR))
        except (EvaError, UnusableEnvironment) as error:
            raise CommandError(str(error)) from None

    def _up(self, lab: Lab, bench: str, pictures: tuple[int, int]) -> None:
        benchmark = _BENCHMARKS[bench]
        with lab.progress.step("its tasks as scenes"):
            scenes = {task: _scene(bench, task) for task in load_schema(bench).choices["task"].values}
        experts = {
            f"{bench}-expert": (0.0, f"{benchmark.experts}."),
            f"{bench}-expert-noisy": (
                benchmark.noise,
                f"The same with noise of one sigma = {benchmark.noise:g} on every number of a row.",
            ),
        }
        served = []
        with lab.progress.step("its experts"):
            for name, (noise, description) in experts.items():
                options = ("--name", name, "--noise", str(noise))
                program = programs.at_bench(f"policy-{name}", bench, "experts.py", options, known_port(name))
                policy = {"url": lab.processes.start(program)["url"]}
                served.append(demo_rows.demo_checkpoint(name=name, description=description, policy=policy))
        how = benches_of({"pictures": pictures, "set": []})
        deployment = settings.BASE_DIR / "deployments" / f"{bench}.toml"
        own = [f'policy.url="{served[0].policy["url"]}"']
        url = lab.start([Bench(deployment, own, options=how.options)])
        with lab.progress.step("accounts and a plan"):
            roles = {"operator": Role.OPERATOR, "admin": Role.ADMIN}
            logins = [demo_rows.demo_login(username=name, role=role) for name, role in roles.items()]
            name = f"{bench}-experts"
            try:
                _plan(name, benchmark, [scenes[task] for task in benchmark.compared], served)
                is_ready = True
            except EvaError as error:
                is_ready = False
                self.stderr.write(f"The plan {name} is left as it is: {error}")
        self.stdout.write(f"\nEVA Web is at {url}\n")
        for login in logins:
            self.stdout.write(f"  {login.username:<10}{login.password}")
        if is_ready:
            self.stdout.write(
                f"\nThe plan {name} is carried out from its page, under Without people, or by\n"
                f"  manage.py evaluate {name} --station {bench} --copies 2"
            )
        self.stdout.write("Ctrl-C ends everything.")
        self.stdout.flush()


def _scene(bench: str, task: str) -> Scene:
    """Return the scene of a task; its pictures are plain, because no expert looks at them."""
    benchmark = _BENCHMARKS[bench]
    return demo_rows.benchmark_scene(
        bench=bench,
        task=task,
        instruction=benchmark.instructions.get(task, task),
        time_limit_s=benchmark.time_limit_s,
        pictures="plain",
    )


def _plan(name: str, benchmark: Benchmark, scenes: Sequence[Scene], served: Sequence[Checkpoint]) -> Plan:
    """Return the frozen blind plan of these tasks, experts against experts with noise."""
    # The checkpoints of a blind plan are hidden from operators: single trials have their own.
    checkpoints = [
        demo_rows.demo_checkpoint(
            name=f"{row.name}-evaluated", description=row.description, policy=row.policy
        )
        for row in served
    ]
    return demo_rows.demo_plan(
        name=name,
        title=f"{benchmark.title}: experts with and without noise",
        question=f"How much does noise on every number of a row cost {benchmark.title}'s experts?",
        owner="admin",
        positions=[position for scene in scenes for position in scene.positions.all()],
        checkpoints=checkpoints,
        repetitions=_REPETITIONS,
        design=StoppingRule.NONE,
    )
