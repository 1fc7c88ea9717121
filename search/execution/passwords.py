"""Texts without the passwords of storages, for logs, notes and reports."""

import re
from urllib.parse import urlsplit


def without_password(text: str) -> str:
    """
    :param text: A URL, a connection string, or a message with such in it
    :return: The same with the passwords replaced by ``***``
    """
    # A user's name may have an @, or a domain before a slash.
    text = re.sub(r"(\b[a-zA-Z][\w+.-]*:/*[^:\s]*):\S*@", r"\1:***@", text)
    text = re.sub(r"(?i)(odbc_connect=)[^&\s]*", r"\1***", text)
    return re.sub(r"(?i)((?:password|passwd|pwd)\s*=\s*)('(?:[^'\\]|\\.)*'(?=[&\s;]|$)|[^&\s]*)", r"\1***", text)


def storage_name(where: str) -> str:
    """
    What messages call a storage.

    :param where: As for ``search.execution.storage.open_storage``, or another argument of a program
    :return: The same without a password, even if it is a URL with an error
    """
    if "://" not in where:
        return without_password(where)
    # Without blanks, which are an error in a URL, and would hide where its password ends.
    shown = without_password("".join(where.split()))
    try:
        _ = urlsplit(shown).port
    except ValueError:
        if "@" not in shown and not shown.startswith("grpc:"):  # the host was forgotten, and the password stands for a port
            return f"{shown.partition('://')[0]}://***"
    return shown
