"""User text as valid LaTeX: names of checkpoints contain underscores, titles anything."""

from __future__ import annotations

import re
import unicodedata

_ASCII = {
    **{letter: f"\\{letter}" for letter in "{}%_&#$"},
    "\\": r"\textbackslash{}",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedblright{}",
    "`": r"\textquoteleft{}",
    "'": r"\textquoteright{}",
}
_SIGNS = {
    "−": "$-$",
    "–": r"\textendash{}",
    "—": r"\textemdash{}",
    "…": r"\ldots{}",
    "\u00a0": "~",
    "“": r"\textquotedblleft{}",
    "”": r"\textquotedblright{}",
    "‘": r"\textquoteleft{}",
    "’": r"\textquoteright{}",
    "×": r"$\times$",
    "±": r"$\pm$",
    "·": r"$\cdot$",
    "°": r"$^{\circ}$",
    "µ": r"$\mu$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "≠": r"$\neq$",
    "→": r"$\rightarrow$",
    "²": "$^{2}$",
    "³": "$^{3}$",
    "ß": r"\ss{}",
    "æ": r"\ae{}",
    "Æ": r"\AE{}",
    "ø": r"\o{}",
    "Ø": r"\O{}",
    "œ": r"\oe{}",
    "Œ": r"\OE{}",
    "ł": r"\l{}",
    "Ł": r"\L{}",
    "ı": r"\i{}",
}
_ACCENTS = {
    "\u0300": "`",
    "\u0301": "'",
    "\u0302": "^",
    "\u0303": "~",
    "\u0304": "=",
    "\u0306": "u",
    "\u0307": ".",
    "\u0308": '"',
    "\u030a": "r",
    "\u030b": "H",
    "\u030c": "v",
    "\u0327": "c",
}
_GREEK = re.compile(
    "GREEK (?:SMALL LETTER (ALPHA|BETA|GAMMA|DELTA|EPSILON|ZETA|ETA|THETA|IOTA|KAPPA|LAMDA|MU|NU|XI|PI|RHO|"
    "SIGMA|TAU|UPSILON|PHI|CHI|PSI|OMEGA)|CAPITAL LETTER (GAMMA|DELTA|THETA|LAMDA|XI|PI|SIGMA|UPSILON|PHI|PSI|OMEGA))"
)


def escaped(text: str) -> str:
    """Return `text` as LaTeX prints it character by character, without packages.

    Characters without a command are unchanged: LuaLaTeX and XeLaTeX print them. Line breaks become blanks.
    """
    letters = "".join(_letter(letter) for letter in unicodedata.normalize("NFC", text))
    return re.sub(r"-(?=-)", "-{}", letters)  # two hyphens would become a dash


def foreign(text: str) -> list[str]:
    """Return the characters that pdfLaTeX does not print."""
    return sorted({letter for letter in unicodedata.normalize("NFC", text) if not _letter(letter).isascii()})


def _letter(letter: str) -> str:
    command = _ASCII.get(letter) or _SIGNS.get(letter)
    if command is not None:
        return command
    if unicodedata.category(letter).startswith(("C", "Z")) and letter != " ":
        return " "
    return letter if letter.isascii() else _accented(letter) or _greek(letter) or letter


def _accented(letter: str) -> str:
    base, *marks = unicodedata.normalize("NFD", letter)
    has_command = base.isascii() and len(marks) == 1 and marks[0] in _ACCENTS
    return f"\\{_ACCENTS[marks[0]]}{{{base}}}" if has_command else ""


def _greek(letter: str) -> str:
    match = _GREEK.fullmatch(unicodedata.name(letter, ""))
    if match is None:
        return ""
    name = match[1].lower() if match[1] else match[2].capitalize()
    return f"$\\{name.replace('lamda', 'lambda').replace('Lamda', 'Lambda')}$"
