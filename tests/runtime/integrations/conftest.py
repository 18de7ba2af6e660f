"""The programs of `runtime/integrations`, each of which is installed into somebody else's environment."""

from __future__ import annotations

import sys
from pathlib import Path

import runtime

_FOLDER = Path(runtime.__file__).parent / "integrations"
sys.path[:0] = [str(folder) for folder in _FOLDER.iterdir() if folder.is_dir()]
