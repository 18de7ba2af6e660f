"""Removal of secrets from texts and tables: known secrets of this machine, and everything that looks like a secret."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from django.conf import settings

from evaweb.blinding.visibility import HIDDEN
from runtime.core.environment import without_web_secrets

REMOVED = "(removed)"
_SHORTEST = 6  # [characters] shorter values are not searched for everywhere, because they occur within words
_WORDS = (
    r"pass(?:word|wd|phrase)?|secret|token|credential|api[_-]?key|private[_-]?key|access[_-]?key|signature"
)
# `..._key` that names a field of a policy's input, not a secret
_PLACES = r"(?:images|state|prompt|language|unnorm)_key"
_KEY = re.compile(rf"{_WORDS}|^auth|authorization|cookie|(?:^|_)pin$|^(?!{_PLACES}$).+_key$", re.IGNORECASE)
_NUMBERS = re.compile(
    r"(?:^|_)(?:pass(?:word|wd|phrase|code)?|pin)$", re.IGNORECASE
)  # a number may be a secret too
_VARIABLES = re.compile(
    r"(?:^|_)KEY$|^EVA_POLICY_", re.IGNORECASE
)  # environment variables, in addition to those of _KEY
_NAMES_ONLY = re.compile(r"_(env|variable)s?$|^variables$")  # keys whose values are names of variables
_NO_NAME = r"(?![\w.-]{0,60}_(?:env|variables?)[\"']?\s*[:=]\s*[\"']?(?-i:[A-Z][A-Z0-9_]*)(?![\w.-]))"
_VALUE = r"(?:\"[^\"\n]*\"|'[^'\n]*'|[^\s,;&\"']+)"
# After blanks alone, only a value that looks like a secret counts: "the password is changed" is a sentence.
_BLANKS = r"(?:[ \t]++(?:is|was)\b)?+(?:[ \t]*+[:=][ \t]*+|[ \t]++)"
_ODD = r"(?=[^\s,;]*[^A-Za-z\s.,:;()'\"-])[^\s,;\"']{4,}"  # four characters or more, not letters alone
# The time of each pattern is linear in the length of the text, for any text.
_PATTERNS = (
    (
        re.compile(
            r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(?:-----END [A-Z ]*PRIVATE KEY-----|\Z)", re.DOTALL
        ),
        REMOVED,
    ),
    (re.compile(r"(?<=://)[^/\s\"'<>]+@"), f"{REMOVED}@"),
    (
        re.compile(r"(?i)\b((?:proxy-)?authorization|set-cookie|cookie|x-api-key)([\"']?\s*[:=]\s*)[^\r\n]+"),
        rf"\1\2{REMOVED}",
    ),
    (re.compile(r"(?i)\bbearer\s+[\w.~+/=-]+"), f"Bearer {REMOVED}"),
    (re.compile(r"\beva_(?:session|csrf)_\w+=[^;\s]+"), REMOVED),
    (
        re.compile(rf"(?i)((?:{_WORDS}){_NO_NAME}[\w.-]{{0,60}}+[\"']?\s*+[:=]\s*+){_VALUE}"),
        rf"\1{REMOVED}",
    ),
    (
        re.compile(
            rf"(?i)((?<![\w-])--[\w-]{{0,60}}(?:{_WORDS})(?![\w-]{{0,60}}[_-](?:env|variables?)\b)"
            rf"[\w-]{{0,60}}[ \t]+){_VALUE}"
        ),
        rf"\1{REMOVED}",
    ),
    (re.compile(rf"(?i)((?<![a-z])(?:{_WORDS}|pin){_BLANKS}){_ODD}"), rf"\1{REMOVED}"),
    (
        re.compile(rf"(?i)((?<![a-z])pass(?:word|wd|phrase|code){_BLANKS})(?:\"[^\"\n]+\"|'[^'\n]+')"),
        rf"\1{REMOVED}",
    ),
    (
        re.compile(
            rf"(?i)(?<!\w)((?!{_PLACES}\b)(?:\w{{1,60}}_key|(?:\w{{1,60}}_)?pin)[\"']?\s*[:=]\s*){_VALUE}"
        ),
        rf"\1{REMOVED}",
    ),
    (re.compile(r"(?i)(?<=[?&])key=[^\s&\"']+"), f"key={REMOVED}"),
    (
        re.compile(
            r"\b(?:hf_\w{16,}|sk-[\w-]{16,}|gh[pousr]_\w{20,}|github_pat_\w{20,}|eva_[\w-]{40,}|AKIA[0-9A-Z]{16}"
            r"|xox[abp]-[\w-]{10,}|eyJ[\w-]{8,}(?:\.[\w-]+)*)"
        ),
        REMOVED,
    ),
)


class Scrubber:
    """Scrubber that removes secrets, and names that are hidden from the reader, from texts and trees."""

    def __init__(self, secrets: Iterable[str], hidden: Iterable[str] = ()) -> None:
        longest_first = sorted(
            {secret for secret in secrets if len(secret) >= _SHORTEST}, key=len, reverse=True
        )
        self._known = re.compile("|".join(map(re.escape, longest_first))) if longest_first else None
        hides = "|".join(map(re.escape, sorted(filter(None, hidden), key=len, reverse=True)))
        self._hidden = re.compile(rf"(?<!\w)(?:{hides})(?!\w)") if hides else None

    def text(self, text: str) -> str:
        """Return any text without secrets and hidden names."""
        if self._known:
            text = self._known.sub(REMOVED, text)
        for pattern, instead in _PATTERNS:
            text = pattern.sub(instead, text)
        return self._hidden.sub(HIDDEN, text) if self._hidden else text

    def tree(self, value: Any) -> Any:
        """Return JSON tables and lists without secrets; values under the name of a secret are always removed."""
        if isinstance(value, Mapping):
            return {self.text(str(key)): self._under(str(key), item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [self.tree(item) for item in value]
        return self.text(value) if isinstance(value, str) else value

    def _under(self, key: str, value: Any) -> Any:
        plain = isinstance(value, bool | int | float | None)
        counts = plain and (value is None or isinstance(value, bool) or not _NUMBERS.search(key))
        if _KEY.search(key) and not _NAMES_ONLY.search(key) and not counts:
            return REMOVED
        return self.tree(value)


def known_secrets() -> set[str]:
    """Return the secrets of this lab that this process can read: keys, passwords, environment variables."""
    data = Path(settings.DATA_DIR)
    files = [data / "secret_key", data / "first_account", *data.glob("stations/*/bus.key")]
    secrets = {settings.SECRET_KEY, *(_read(path) for path in files)}
    database = settings.DATABASES["default"]
    secrets.add(str(database.get("PASSWORD") or ""))
    harmless = without_web_secrets(os.environ)
    for name, value in os.environ.items():
        if name not in harmless or _KEY.search(name) or _VARIABLES.search(name):
            secrets |= {value, *_passwords(value)}
    return {secret for secret in secrets if secret}


def _read(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8", "replace").strip()
    except OSError:
        return ""


def _passwords(url: str) -> set[str]:
    """Return the password in a URL, as written and decoded."""
    try:
        password = urlsplit(url).password
    except ValueError:
        return set()
    return {password, unquote(password)} if password else set()
