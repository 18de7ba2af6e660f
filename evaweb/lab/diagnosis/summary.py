"""First page of a bundle: notable findings and contents, as text and as an offline HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

_STYLE = """
body { max-width: 70em; margin: 2em auto; padding: 0 1em; font: 15px/1.45 system-ui, sans-serif; color: #28313b; }
h1 { font-size: 22px; } h2 { font-size: 17px; margin-top: 1.6em; }
li { margin: .3em 0; overflow-wrap: anywhere; }
pre { white-space: pre-wrap; overflow-wrap: anywhere; }
"""


@dataclass(frozen=True, slots=True)
class Section:
    """Heading and lines; a line may name a file of the bundle with details."""

    title: str
    lines: tuple[tuple[str, str], ...]


def sections(
    parts: dict[str, Any], contents: Sequence[tuple[str, int]], notes: Sequence[str]
) -> list[Section]:
    """Return the sections of notable findings in `parts`, which are keyed by file name.

    `contents` are files with their sizes [bytes], `notes` sentences on what the bundle omits.
    """
    versions, lines = parts["versions.json"], parts["machine.json"]
    rows = parts.get("database.json")
    migrations = f"{len(rows['migrations_to_apply'])} migrations to apply" if rows else "which cannot be read"
    failed = [job for job in parts.get("jobs.json", ()) if job["status"] == "failed"]
    return [
        Section("Not in this bundle", tuple((note, "") for note in notes)),
        Section(
            "Program",
            (
                (f"revision {_revision(versions['revision'])}", "versions.json"),
                (f"Python {versions['python']}, {versions['kernel']}, {versions['system']}", ""),
                (
                    f"database {parts['settings.json']['database']}, {migrations}",
                    "database.json" if rows else "",
                ),
            ),
        ),
        Section(
            "Machine",
            tuple((f"{line['state']}: {line['name']}: {line['found']}", "") for line in lines),
        ),
        Section("Stations", tuple(_stations(parts)) or (("none", ""),)),
        Section(
            "Jobs",
            tuple((f"failed: {job['key']}: {job['error']}", "jobs.json") for job in failed[:20])
            or (("none of the newest has failed", "jobs.json"),),
        ),
        Section("Files", tuple((f"{name}, {size:,} bytes", name) for name, size in contents)),
    ]


def as_text(title: str, found: Sequence[Section]) -> str:
    """Return the summary for a terminal."""
    lines = [title, "=" * len(title)]
    for section in found:
        lines += ["", section.title, "-" * len(section.title), *(f"  {line}" for line, _ in section.lines)]
    return "\n".join(lines) + "\n"


def as_html(title: str, found: Sequence[Section]) -> str:
    """Return the summary for a browser: one file without scripts and external resources."""
    body = "".join(
        f"<h2>{escape(section.title)}</h2><ul>{''.join(map(_item, section.lines))}</ul>" for section in found
    )
    head = f"<meta charset='utf-8'><title>{escape(title)}</title><style>{_STYLE}</style>"
    return f"<!doctype html><html lang='en'><head>{head}</head><body><h1>{escape(title)}</h1>{body}</body></html>\n"


def _revision(revision: Any) -> str:
    if isinstance(revision, str):
        return revision
    return f"{revision['commit'][:12]}{', with changes' if revision['dirty'] else ''}"


def _item(line: tuple[str, str]) -> str:
    text, file = line
    link = f" (<a href='{escape(file)}'>{escape(file)}</a>)" if file else ""
    return f"<li>{escape(text)}{link}</li>"


def _stations(parts: dict[str, Any]) -> list[tuple[str, str]]:
    rows = []
    for file, content in parts.items():
        if file.startswith("stations/") and file.endswith("/state.json"):
            name = content["station"]["name"]
            snapshot = content.get("snapshot")
            if snapshot is None:
                rows.append((f"{name}: {content['gone']}", file))
            else:
                rows.append(
                    (f"{name}: {snapshot.get('state')}: {snapshot.get('reason') or 'no reason'}", file)
                )
    return rows
