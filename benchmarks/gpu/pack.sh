#!/usr/bin/env bash
# Collect the wheels that run.sh needs on a machine without a network into benchmarks/gpu/wheels, which git ignores:
#
#     benchmarks/gpu/pack.sh
#
# For CPython 3.12 on x86-64 Linux, in the versions of constraints.txt. What such a machine has already (torch, NumPy,
# pandas, OpenCV, matplotlib, tqdm, rich) is not among them, so that nothing of it is replaced.
set -euo pipefail
cd "$(dirname "$0")/../.."
PYTHON=${PYTHON:-python3}
WHEELS=${WHEELS:-benchmarks/gpu/wheels}
PACKAGES=(stable-baselines3 sb3-contrib gymnasium highway-env farama-notifications pygame-ce)

pinned=()
for package in "${PACKAGES[@]}"; do
    pinned+=("$(grep -E "^$package==[^;]*$" constraints.txt)")
done
rm -rf "$WHEELS"
"$PYTHON" -m pip download --quiet --dest "$WHEELS" --no-deps --only-binary=:all: --implementation cp \
    --python-version 3.12 --platform manylinux2014_x86_64 --platform manylinux_2_28_x86_64 "${pinned[@]}"
ls -l "$WHEELS"
megabytes=$(du -sm "$WHEELS" | cut -f1)
echo "$megabytes MiB in $WHEELS"
if [ "$megabytes" -gt 64 ]; then
    echo "More than the 64 MiB that may travel with a working tree." >&2
    exit 1
fi
