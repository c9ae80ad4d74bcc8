"""The packages of the extra "export", imported where they are used."""

from importlib import import_module
from typing import Any


def require(name: str, *submodules: str) -> Any:
    """
    The package ``name``.

    :param submodules: to import as well
    :raises ImportError: if it is not installed; says how to install it
    """
    try:
        for module in submodules:
            import_module(module)
        return import_module(name)
    except ImportError as error:
        raise ImportError(f'{name} is needed to export policies: pip install "sb3_have[export]" ({error})') from error
