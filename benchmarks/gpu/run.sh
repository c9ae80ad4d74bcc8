#!/usr/bin/env bash
# Measures and proves training on a GPU in nine minutes, on a machine that can reach nothing. Once, where there is a
# network, benchmarks/gpu/pack.sh; then, with the tree and benchmarks/gpu/wheels on the other machine:
#
#     benchmarks/gpu/run.sh                    # all parts: checks speed graph training
#     benchmarks/gpu/run.sh training           # one part; here, the runs go on from their checkpoints
#     benchmarks/gpu/run.sh compile            # not in all: what takes long to compile
#     DEVICE=cpu benchmarks/gpu/run.sh         # everything small, to try the script
#
# The results go to the folder $OUT (benchmarks/results/gpu by default), a few files that grow as it runs:
# correctness.csv, compile.csv, update_speed.csv, graph.csv, training.csv, curves.tar.gz and log.txt. Of the machine it
# uses Python with torch and what goes with it; the wheels are unpacked into a temporary folder. Every part has a time
# limit, and one that fails stops none of the others; the exit code is 1 if any failed. LIMIT is the time in all, in
# seconds; the checks take 100 of it at most, the speed 160, the graph 90, and the training what is left.
set -uo pipefail
cd "$(dirname "$0")/../.." || exit 1
DEVICE=${DEVICE:-cuda}
PYTHON=${PYTHON:-python3}
OUT=${OUT:-benchmarks/results/gpu}
LIMIT=${LIMIT:-540}
WHEELS=${WHEELS:-benchmarks/gpu/wheels}
RUNS=${RUNS:-runs/gpu-$DEVICE}
PARTS=("$@")
[ $# -gt 0 ] || PARTS=(checks speed graph training)

mkdir -p "$OUT"
OUT=$(cd "$OUT" && pwd)
exec > >(tee -a "$OUT/log.txt") 2>&1
site=$(mktemp -d)
trap 'rm -rf "$site"' EXIT
failed=0

# Seconds that are left.
left() { echo $((LIMIT - SECONDS)); }

# Run a command for so many seconds at most, and no longer than there is time.
part() {
    local limit=$1
    shift
    if [ "$(left)" -lt "$limit" ]; then limit=$(left); fi
    if [ "$limit" -lt 5 ]; then
        echo "-- no time: $*"
        failed=1
        return 1
    fi
    echo "-- after $SECONDS s, for at most $limit s: $*"
    timeout --kill-after=5 "$limit" "$PYTHON" -m "$@"
    local code=$?
    if [ "$code" -eq 124 ] || [ "$code" -eq 137 ]; then
        echo "-- out of time"
    elif [ "$code" -ne 0 ]; then
        echo "-- exit code $code"
    fi
    [ "$code" -eq 0 ] || failed=1
    return "$code"
}

# Without --no-deps, pip would replace torch and NumPy. sb3_have runs from the tree, and needs to be known by its
# version.
"$PYTHON" -m pip install --quiet --no-deps --no-index --no-compile --no-cache-dir --disable-pip-version-check \
    --find-links "$WHEELS" --target "$site" "$WHEELS"/*.whl || exit 1
version=$(cat sb3_have/version.txt)
mkdir -p "$site/sb3_have-$version.dist-info"
printf 'Metadata-Version: 2.1\nName: sb3_have\nVersion: %s\n' "$version" >"$site/sb3_have-$version.dist-info/METADATA"
export PYTHONPATH="$PWD:$site${PYTHONPATH:+:$PYTHONPATH}"
export PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1 SDL_VIDEODRIVER=dummy
export TORCHINDUCTOR_CACHE_DIR=$site/inductor
command -v nvidia-smi >/dev/null && nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv
"$PYTHON" -c 'import sys, torch; print("Python", *sys.version.split()[:1], "torch", torch.__version__)'

if [ "$DEVICE" = cpu ]; then
    checks=(--image-size 36 --batch-size 8)
    speed=(--shapes a --modalities 2 --batch-size 4 --rounds 1 --precisions float32)
    graph=(--image-size 36 --batch-sizes 8 --rounds 2 --precision float32)
    training=(--configs have --seeds 0)
else
    checks=()
    speed=(--modalities 2 --rounds 7 --precisions bfloat16)
    graph=()
    training=()
fi

# Rows of update_speed, until $until at the latest.
speed() {
    local limit=$1
    shift
    if [ $((until - SECONDS)) -lt "$limit" ]; then limit=$((until - SECONDS)); fi
    part "$limit" benchmarks.update_speed --device "$DEVICE" --output "$OUT/update_speed.csv" "${speed[@]}" "$@"
}

# While the checks run, whose speed is of no interest: is what is compiled right, and the compiler's cache for later.
compile_meanwhile() {
    part 100 benchmarks.gpu.checks --device "$DEVICE" --output "$OUT/compile.csv" --only compile "${checks[@]}" \
        >"$site/compile.txt" 2>&1 &
    compile=$!
    part 100 benchmarks.update_speed --device "$DEVICE" --output "$site/warm-up.csv" --modalities 2 --rounds 1 \
        --precisions bfloat16 --shapes b --storage device --skip-sb3 --compile >"$site/warm-up.txt" 2>&1 &
    warm_up=$!
}

for name in "${PARTS[@]}"; do
    case $name in
        checks)
            [ "$DEVICE" = cpu ] || compile_meanwhile
            part 90 benchmarks.gpu.checks --device "$DEVICE" --output "$OUT/correctness.csv" --skip compile \
                "${checks[@]}"
            if [ "$DEVICE" != cpu ]; then
                wait "$compile" || failed=1
                wait "$warm_up" || echo "-- the compiler's cache is not complete"
                cat "$site/compile.txt"
                tail -n 20 "$site/warm-up.txt"
            fi
            ;;
        speed)
            until=$((SECONDS + 160))
            if [ "$DEVICE" = cpu ]; then
                speed 60
            else
                speed 45 --shapes b --storage device
                speed 45 --shapes b
                speed 45 --shapes b --storage device --batch-size 512
                speed 35 --shapes a
                speed 90 --shapes b --storage device --compile
            fi
            ;;
        graph)
            part 90 benchmarks.gpu.graph --device "$DEVICE" --output "$OUT/graph.csv" "${graph[@]}"
            ;;
        compile)
            until=$LIMIT
            part 120 benchmarks.gpu.checks --device "$DEVICE" --output "$OUT/compile.csv" --only compile "${checks[@]}"
            if [ "$DEVICE" != cpu ]; then
                speed 90 --shapes b --storage device --batch-size 512 --compile
                speed 90 --shapes a --compile
                part 120 benchmarks.gpu.graph --device "$DEVICE" --output "$OUT/graph.csv" --compile --batch-sizes 128
            fi
            ;;
        training)
            part "$(left)" benchmarks.gpu.training --device "$DEVICE" --output "$OUT/training.csv" --runs "$RUNS" \
                --seconds $(($(left) - 15)) "${training[@]}"
            ;;
        *)
            echo "unknown part $name: expected checks, speed, graph, compile or training"
            failed=1
            ;;
    esac
done
echo "-- done after $SECONDS s, exit code $failed"
exit $failed
