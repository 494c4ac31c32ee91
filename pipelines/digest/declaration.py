"""Read the receivers of the digest that `notify.toml` in the home declares."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from hdt_core.loading import UserError
from pipelines.storage.objects import StoreError
from pipelines.storage.settings import notify_file, read_values


class NotifyError(UserError):
    """A wrong declaration or a failed receiver; one line without a secret."""


@dataclass(frozen=True, slots=True)
class Receiver:
    """One receiver.

    Attributes
    ----------
    name : str
        Its name in messages and in the record of what was sent.
    kind : str
        mail, webhook or file.
    operator : str or None
        Limit the digest to this operator.
    settings : dict
        Keys of its kind, see `KINDS`, with their defaults.
    """

    name: str
    kind: str
    operator: str | None
    settings: dict[str, Any]

    def secret(self, setting: str) -> str:
        """Return the value of the environment variable that a setting names; empty where it names none."""
        variable = self.settings[setting]
        if not variable:
            return ""
        if not (value := os.environ.get(variable, "")):
            raise NotifyError(f"the environment has no {variable}")
        return value


NO_DEFAULT = object()
KINDS: dict[str, dict[str, Any]] = {
    "mail": {
        "host": NO_DEFAULT, "port": 587, "security": "starttls", "from": NO_DEFAULT, "to": [], "user_env": "",
        "password_env": "", "ca_file": "",
    },
    "webhook": {"url": "", "url_env": ""},
    "file": {"folder": NO_DEFAULT},
}  # fmt: skip
_SECURITY = ("starttls", "tls", "none")
_LOOPBACK = ("127.0.0.1", "::1", "localhost")


def receivers_of(home: Path) -> list[Receiver]:
    """Return the receivers that a home declares, one `[[receiver]]` each; none where it has no `notify.toml`.

    Raises
    ------
    NotifyError
        The file is no TOML, or a key is missing, unknown or invalid; file, receiver and key are named.
    """
    file = notify_file(home)
    try:
        entries = read_values(file, ("receiver",)).get("receiver", [])
    except StoreError as error:
        raise NotifyError(str(error)) from None
    try:
        return _receivers(entries)
    except NotifyError as error:
        raise NotifyError(f"{file}: {error}") from None


def _receivers(entries: Any) -> list[Receiver]:
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise NotifyError("receiver is not a list; write [[receiver]] with two brackets")
    receivers = [_receiver(entry, f"receiver {n}") for n, entry in enumerate(entries, 1)]
    names = [r.name for r in receivers]
    if double := sorted({n for n in names if names.count(n) > 1}):
        raise NotifyError(f"two receivers are called {double[0]!r}")
    return receivers


def _receiver(entry: dict[str, Any], where: str) -> Receiver:
    name = entry.get("name", "")
    if not isinstance(name, str) or not name or not name.isprintable():
        raise NotifyError(f"{where}: name is missing, or not a text of one line")
    where = f"{where} ({name})"
    kind = entry.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise NotifyError(f"{where}: kind is {kind!r}; there are {', '.join(KINDS)}")
    defaults = KINDS[kind]
    if unknown := sorted(set(entry) - set(defaults) - {"name", "kind", "operator"}):
        raise NotifyError(f"{where}: unknown key {unknown[0]}; a receiver of kind {kind} has {', '.join(defaults)}")
    settings = {key: _value(entry, key, default, where) for key, default in defaults.items()}
    if kind == "mail":
        _check_mail(settings, where)
    elif kind == "webhook":
        _check_webhook(settings, where)
    operator = _value(entry, "operator", "", where)
    return Receiver(name, kind, operator or None, settings)


def _value(entry: dict[str, Any], key: str, default: Any, where: str) -> Any:
    if key not in entry:
        if default is NO_DEFAULT:
            raise NotifyError(f"{where}: {key} is missing")
        return default
    value = entry[key]
    kind = str if default is NO_DEFAULT else type(default)
    if not isinstance(value, kind) or isinstance(value, bool) or (kind is str and not value.isprintable()):
        shown = "" if key.startswith("url") else f" is {value!r} and"  # an address may hold a secret
        raise NotifyError(f"{where}: {key}{shown} ought to be {_TYPES[kind]}")
    if key.endswith("_env") and value and not re.fullmatch(r"[A-Za-z_]\w*", value, re.ASCII):
        raise NotifyError(f"{where}: {key} ought to be the name of a variable of the environment")
    return value


_TYPES = {str: "a text of one line", int: "a number", list: "a list of texts"}


def _check_webhook(settings: dict[str, Any], where: str) -> None:
    if bool(settings["url"]) == bool(settings["url_env"]):
        raise NotifyError(f"{where}: give either url or url_env, the variable that holds it")
    if settings["url"]:
        check_url(settings["url"], where)


def _check_mail(settings: dict[str, Any], where: str) -> None:
    if not 1 <= settings["port"] <= 65535:
        raise NotifyError(f"{where}: port is {settings['port']} and ought to be 1 to 65535")
    if not settings["to"] or not all(isinstance(to, str) and "@" in to for to in settings["to"]):
        raise NotifyError(f"{where}: to is a list of addresses, one at least")
    if settings["security"] not in _SECURITY:
        raise NotifyError(f"{where}: security is {settings['security']!r}; there are {', '.join(_SECURITY)}")
    if bool(settings["user_env"]) != bool(settings["password_env"]):
        raise NotifyError(f"{where}: give both user_env and password_env, or neither")
    if settings["password_env"] and settings["security"] == "none":
        raise NotifyError(f"{where}: a password needs an encrypted connection; set security to starttls or tls")


def check_url(url: str, where: str) -> str:
    """Return `url` if a digest may go there. It may hold a secret, so an error does not quote it."""
    if not re.fullmatch(r"[!-~]+", url):
        raise NotifyError(f"{where}: the url has a blank or another character that has to be written as %XX")
    try:
        parts = urlsplit(url)
        parts.port  # noqa: B018  # raises where it is no port
    except ValueError:  # its message would quote the address
        raise NotifyError(f"{where}: the url is invalid") from None
    if "@" in parts.netloc:
        raise NotifyError(f"{where}: the url has a user before its host, which no webhook is sent")
    if parts.scheme == "https" and parts.hostname:
        return url
    if parts.scheme == "http" and parts.hostname in _LOOPBACK:
        return url
    raise NotifyError(f"{where}: the url has to begin with https:// (http:// only to this machine)")
