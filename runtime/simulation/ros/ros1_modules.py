"""Import of rospy from another Python installation, such as Debian's; rospy is pure Python.

A folder of links to rospy's packages is appended to the end of sys.path, so that nothing else of the other installation
can be imported. Packages that this Python has itself are not linked.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from runtime.core.errors import SetupError

_PACKAGES = (
    "catkin", "catkin_pkg", "defusedxml", "genmsg", "genpy", "geometry_msgs", "pyparsing", "roscpp", "rosgraph",
    "rosgraph_msgs", "roslib", "rospkg", "rospy", "sensor_msgs", "std_msgs", "std_srvs", "yaml",
)  # fmt: skip
_NEEDED = {"rospy", "sensor_msgs", "geometry_msgs"}
_FIND = (  # program that prints the origins of packages
    "import importlib.util as u, json, sys; "
    "print(json.dumps({n: s.origin for n in sys.argv[1:] for s in [u.find_spec(n)] if s and s.origin}))"
)


@contextmanager
def lent(python: str) -> Iterator[None]:
    """Make rospy of the Python installation `python` importable within the context.

    Raises:
        SetupError: If that installation lacks a needed package, or cannot be run.
    """
    needed = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    origins = _places(python, needed)
    missing = _NEEDED & set(needed) - origins.keys()
    if missing:
        raise SetupError(
            f"{python} lacks {', '.join(sorted(missing))}; install them: apt-get install python3-rospy "
            "python3-sensor-msgs, or name another one with --python"
        )
    with tempfile.TemporaryDirectory() as folder:
        for origin in origins.values():
            place = Path(origin).parent if Path(origin).name == "__init__.py" else Path(origin)
            (Path(folder) / place.name).symlink_to(place)
        sys.path.append(folder)
        try:
            yield
        finally:
            sys.path.remove(folder)


def _places(python: str, names: Iterable[str]) -> dict[str, str]:
    try:
        completed = subprocess.run(
            [python, "-c", _FIND, *names], capture_output=True, text=True, timeout=20, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise SetupError(f"{python} cannot be asked for its rospy: {error}") from error
    origins: dict[str, str] = json.loads(completed.stdout)
    return origins
