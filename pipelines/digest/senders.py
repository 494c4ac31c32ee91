"""Send a digest by e-mail, webhook or file; a slow or busy receiver is tried three times."""

import json
import smtplib
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from email.message import EmailMessage
from email.utils import formatdate
from pathlib import Path
from typing import Any

from pipelines.digest.changes import Digest
from pipelines.digest.declaration import NotifyError, Receiver, check_url
from pipelines.digest.render import as_html, as_json, as_text, as_webhook, subject, write_digest

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
        user, password = receiver.secret("user_env"), receiver.secret("password_env")
        message = _message(receiver, digest, name)
        _attempt(lambda: _mail(receiver.settings, message, user, password), user, password)
    else:
        url = receiver.settings["url"] or check_url(receiver.secret("url_env"), receiver.settings["url_env"])
        body = json.dumps(as_webhook(digest)).encode()
        _attempt(lambda: _post(url, body, name), url)


def _attempt(send_once: Callable[[], None], *secrets: str) -> None:
    """Try, and try again where a retry may help; raise the last error as one line."""
    for wait in (*WAITS_S, None):
        try:
            return send_once()
        except (OSError, ValueError) as error:  # smtplib's and urllib's are kinds of OSError
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
