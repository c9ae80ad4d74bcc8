"""The C library's allocator, set for arrays of many megabytes."""

import ctypes

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # malloc.h


def keep_freed_memory() -> bool:
    """
    Lets glibc keep freed memory for the next allocation, instead of giving it back to the system.

    A training step on a CPU allocates and frees activations of many megabytes; by default the system takes them back
    and has to clear every page again in the next step, which can cost a third of it (``benchmarks.update_speed``). The
    process then never shrinks below its peak. Programs call this, before they train; a library should not, so
    :class:`~sb3_have.HAVESAC` does not. In the shell, the same is
    ``MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=100000000000``.

    :return: whether there was such an allocator (Linux with glibc)
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(mallopt(M_MMAP_MAX, 0) and mallopt(M_TRIM_THRESHOLD, -1))
