"""Names in the logger that stay different when they are printed."""

from collections.abc import Iterable


def log_names(names: Iterable[str], length: int) -> dict[str, str]:
    """
    Shorten names for SB3's logger.

    Its table cuts keys to 36 characters, and training ends with an error if two of them are equal then (SB3's
    issue #750).

    :param names: Different names
    :param length: Maximum number of characters
    :return: The short name of each name; names that are not too long stay the same
    """
    short: dict[str, str] = {}
    for name in sorted(names, key=lambda name: len(name) > length):
        half = (length - 3) // 2
        short[name] = name if len(name) <= length else f"{name[:half]}...{name[-half:]}"
        number = 1
        while list(short.values()).count(short[name]) > 1:
            number += 1
            short[name] = f"{name[: length - len(f'~{number}')]}~{number}"
    return short
