"""URLs of cameras on the network: what they may be, and how a password gets into one without being written down."""

from __future__ import annotations

from urllib.parse import quote, urlsplit, urlunsplit

from runtime.core.environment import read_secret
from runtime.core.errors import ConfigurationError


def check_url(key: str, url: str, schemes: tuple[str, ...]) -> str:
    """`url` itself; raises ConfigurationError where it is none of `schemes`, has no host, or a password in it."""
    allowed = " or ".join(f"{scheme}://HOST[:PORT]/PATH" for scheme in schemes)
    try:
        parts = urlsplit(url)
        usable = parts.scheme in schemes and bool(parts.hostname) and (parts.port or 1) > 0
    except ValueError:
        usable, parts = False, urlsplit("")
    if "@" in parts.netloc:
        raise ConfigurationError(
            f"{key} names a user or a password, and would be written into every manifest; allowed: {allowed} "
            "with `user` and `password_env`, the name of an environment variable"
        )
    if not usable:
        raise ConfigurationError(f"{key} = {url!r}; allowed: {allowed}")
    return url


def with_password(url: str, user: str | None, variable: str | None) -> str:
    """`url` with the user, and the password that the environment holds; ConfigurationError where it holds none."""
    if user is None:
        return url
    name = quote(user, safe="")
    if variable is not None:
        name += ":" + quote(read_secret("password_env", variable), safe="")
    parts = urlsplit(url)
    return urlunsplit(parts._replace(netloc=f"{name}@{parts.netloc}"))
