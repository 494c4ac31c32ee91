"""Send each receiver the changes since its last digest; retry failures the next night.

`notify/sent.json` in the home records for each receiver the night of its last digest and the state it described. It is
written after each receiver, so a night that is killed and repeated sends again only the digest in progress at that
moment; a repeated e-mail bears the same Message-ID. A slow or busy receiver is tried three times.
"""

import json
import smtplib
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from email.message import EmailMessage
from email.utils import formatdate
from http.client import HTTPException
from pathlib import Path
from typing import Any

from pipelines.digest.changes import EMPTY, Digest, Row, State, compare, read_state
from pipelines.digest.declaration import NotifyError, Receiver, check_url, receivers_of
from pipelines.digest.render import as_html, as_json, as_text, as_webhook, subject, write_digest
from pipelines.report.tasks import read_tasks
from pipelines.storage.catalog_checks import connect_current
from pipelines.storage.files import replacing
from pipelines.storage.ledger import Ledger
from pipelines.versions import digest as hash_text

TIMEOUT_S = 20.0
WAITS_S = (2.0, 8.0)
"""Pauses before the second and the third attempt. [s]"""


def send(receiver: Receiver, digest: Digest, name: str, home: Path) -> None:
    """Send a digest to one receiver, or raise.

    Parameters
    ----------
    name : str
        Id of this digest, the same on every attempt, so that the receiver recognises a repeated one.
    home : Path
        Relative folders lie below it.

    Raises
    ------
    NotifyError
        The receiver did not accept it; the line holds no secret.
    """
    if receiver.kind == "file":
        _attempt(lambda: _write(home / receiver.settings["folder"], digest))
    elif receiver.kind == "mail":
        user = receiver.secret("user_env")
        password = receiver.secret("password_env")
        message = _message(receiver, digest, name)
        _attempt(lambda: _mail(receiver.settings, message, user, password), user, password)
    else:
        url = receiver.settings["url"] or check_url(receiver.secret("url_env"), receiver.settings["url_env"])
        body = json.dumps(as_webhook(digest)).encode()
        _attempt(lambda: _post(url, body, name))


def _attempt(send_once: Callable[[], None], *secrets: str) -> None:
    """Try, and try again where a retry may help; raise the last error as one line."""
    for wait in (*WAITS_S, None):
        try:
            return send_once()
        except (OSError, ValueError, HTTPException) as error:  # smtplib's and urllib's are kinds of OSError
            if wait is None or not _is_transient(error):
                raise NotifyError(_error_line(error, secrets)) from None
            time.sleep(wait)
    return None


def _is_transient(error: Exception) -> bool:
    """Test for an error that a later attempt may not meet."""
    if isinstance(error, urllib.error.HTTPError):
        return error.code == 429 or error.code >= 500
    if isinstance(error, smtplib.SMTPResponseException):
        return 400 <= error.smtp_code < 500
    if isinstance(error, smtplib.SMTPRecipientsRefused | smtplib.SMTPNotSupportedError | ssl.SSLCertVerificationError):
        return False
    return isinstance(error, OSError)


def _error_line(error: Exception, secrets: tuple[str, ...]) -> str:
    """Describe an error in one line; of an address in words of our own, since a library would quote parts of it."""
    if isinstance(error, urllib.error.HTTPError):
        error.close()
        return f"the address answered with HTTP status {error.code}"
    if isinstance(error, urllib.error.URLError):
        return f"the address could not be reached ({type(error.reason).__name__})"
    if isinstance(error, HTTPException):
        return f"the address did not answer in HTTP ({type(error).__name__})"
    line = " ".join(str(error).split())[:200] or type(error).__name__
    for secret in filter(None, secrets):
        line = line.replace(secret, "***")
    return line


def _message(receiver: Receiver, digest: Digest, name: str) -> EmailMessage:
    message = EmailMessage()
    message["Subject"] = subject(digest)
    message["From"] = receiver.settings["from"]
    message["To"] = ", ".join(receiver.settings["to"])
    message["Date"] = formatdate()
    message["Message-ID"] = f"<{name}@hybrid-digital-twin>"
    message["Auto-Submitted"] = "auto-generated"
    message.set_content(as_text(digest))
    message.add_alternative(as_html(digest), subtype="html")
    message.add_attachment(as_json(digest).encode(), maintype="application", subtype="json", filename="digest.json")
    return message


def _mail(settings: dict[str, Any], message: EmailMessage, user: str, password: str) -> None:
    context = ssl.create_default_context(cafile=settings["ca_file"] or None)
    address = settings["host"], settings["port"]
    if settings["security"] == "tls":
        server: smtplib.SMTP = smtplib.SMTP_SSL(*address, timeout=TIMEOUT_S, context=context)
    else:
        server = smtplib.SMTP(*address, timeout=TIMEOUT_S)
    try:
        if settings["security"] == "starttls":
            server.starttls(context=context)
        if user:
            server.login(user, password)
        server.send_message(message)
    finally:
        server.close()  # no QUIT, whose answer a broken connection would delay


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Refuse redirects: a digest goes to the declared address only."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


def _post(url: str, body: bytes, name: str) -> None:
    headers = {"Content-Type": "application/json", "Idempotency-Key": name, "User-Agent": "hybrid-digital-twin"}
    request = urllib.request.Request(url, data=body, headers=headers, method="POST")
    with urllib.request.build_opener(_NoRedirect).open(request, timeout=TIMEOUT_S) as response:
        response.read(1000)


def _write(folder: Path, digest: Digest) -> None:
    stem = "digest-" + (digest.until or "none").replace(" ", "-").replace(":", "")
    write_digest(digest, folder, stem)


_FOLDER, _RECORD = "notify", "sent.json"


def send_digests(home: Path) -> list[str]:
    """Send each receiver what changed since its last digest; return a line for each failure.

    Without a change nothing is sent. A receiver that failed gets tonight's changes with the next night's.
    """
    try:
        receivers = receivers_of(home)
        night = Ledger(home, read_only=True).last_night() if receivers else ""
        record: dict[str, Any] = _read_json(home / _FOLDER / _RECORD)
        waiting = [r for r in receivers if record.get(r.name, {}).get("night") != night]
        if not waiting or not night:
            return []
        with connect_current(home) as con:
            now = read_state(con, read_tasks(home))
    except Exception as error:  # the night is published whether or not its digest can be sent
        return [f"no digest was sent: {error}"]
    failures = [line for r in waiting if (line := _deliver(home, r, now, night, record))]
    _remove_unused_states(home, record)
    return failures


def send_trial(home: Path) -> list[tuple[str, str]]:
    """Send every receiver the present state as if it were new, record nothing; return each name and its error."""
    with connect_current(home) as con:
        now = read_state(con, read_tasks(home))
    results = []
    for receiver in receivers_of(home):
        digest = compare(EMPTY, now).of(receiver.operator)
        try:
            send(receiver, digest, hash_text("trial", receiver.name, as_json(digest)), home)
        except NotifyError as error:
            results.append((receiver.name, str(error)))
        else:
            results.append((receiver.name, ""))
    return results


def send_failure(home: Path, reasons: Iterable[str]) -> list[str]:
    """Send why a night failed to the receivers of all operators; return a line for each that was not reached."""
    until = f"{datetime.now(UTC):%Y-%m-%d %H:%M}"
    rows: list[Row] = [{"file": "night", "reasons": reason} for reason in reasons]
    digest = Digest(None, until, {"failed": rows})
    failures = []
    for receiver in (r for r in receivers_of(home) if r.operator is None):
        try:
            send(receiver, digest, hash_text(receiver.name, as_json(digest)), home)
        except NotifyError as error:
            failures.append(f"{receiver.name} got no message of the failed night: {error}")
    return failures


def _deliver(home: Path, receiver: Receiver, now: State, night: str, record: dict[str, Any]) -> str:
    """Send to one receiver and record it; return the error, empty where there is none."""
    entry = record.get(receiver.name, {})
    before = EMPTY | _read_json(home / _FOLDER / entry["told"]) if "told" in entry else EMPTY
    digest = compare(before, now).of(receiver.operator)
    if digest.changes:
        try:
            send(receiver, digest, hash_text(receiver.name, as_json(digest)), home)
        except Exception as error:  # no receiver may end a night, whatever its library raises
            reason = error if isinstance(error, NotifyError) else type(error).__name__
            return f"{receiver.name} got no digest; the next night tries again: {reason}"
        entry = {"told": _write_state(home, now)}
    record[receiver.name] = entry | {"night": night}
    _write_json(home / _FOLDER / _RECORD, record)
    return ""


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    with replacing(path) as file:
        file.write_text(json.dumps(content, indent=1), encoding="utf-8")


def _write_state(home: Path, now: State) -> str:
    """Write a state, without its closed alerts, and return its file name."""
    state = now | {"closed": {}}
    name = f"state-{hash_text(json.dumps(state))}.json"
    if not (home / _FOLDER / name).exists():
        _write_json(home / _FOLDER / name, state)
    return name


def _remove_unused_states(home: Path, record: dict[str, Any]) -> None:
    state_names = {entry.get("told") for entry in record.values()}
    for file in (home / _FOLDER).glob("state-*.json"):
        if file.name not in state_names:
            file.unlink(missing_ok=True)
