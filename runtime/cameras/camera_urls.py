"""URLs of network cameras: checks, and insertion of passwords.

Passwords come from the environment and are never recorded.
"""

from __future__ import annotations

from urllib.parse import quote, urlsplit, urlunsplit

from runtime.core.environment import read_secret
from runtime.core.errors import ConfigurationError


def check_url(key: str, url: str, schemes: tuple[str, ...]) -> str:
    """Return `url` after checking it.

    Raises:
        ConfigurationError: Its scheme is not in `schemes`, it has no host, or it contains a user or password.
    """
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
    """Return `url` with the user, and with the password in the environment variable `variable`.

    Raises ConfigurationError.
    """
    if user is None:
        return url
    name = quote(user, safe="")
    if variable is not None:
        name += ":" + quote(read_secret("password_env", variable), safe="")
    parts = urlsplit(url)
    return urlunsplit(parts._replace(netloc=f"{name}@{parts.netloc}"))
