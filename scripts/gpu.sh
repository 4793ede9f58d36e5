#!/usr/bin/env bash
# Everything that needs a GPU, in under 25 minutes, on a Linux with CUDA and torch and no network.
#
#   scripts/gpu.sh                       writes results/gpu/: one log and the result of every step, as each ends
#   DEVICE=cpu SHAPES="nano tiny" SCALE=nano EPISODES=1 scripts/gpu.sh     a trial without a GPU
#
# PYTHON   the interpreter that has torch                (.venv/bin/python where it exists, else python3)
# WHEELS   folder of wheels for packages that are missing (wheels)
# OUT      where results go                               (results/gpu)
# STUDY    folder of the study whose decodes are priced  (results/studies/main)
# DEMOS    folder of the demonstrations to train on       (results/artifacts/demos/mt50)
# SHAPES   shapes that are measured                       (vla-150m smolvla openvla-7b)
# SCALE    shape of the prices                            (openvla-7b)
# EPISODES per task and setting in the shipped policy's study (2)
# TRAIN    settings of the training, which goes on from the shipped policy of fifty tasks
#          (train=mt50 train.init=mt50-vision train.scene_steps=0 train.batch=256 world.camera.name=corner4+gripperPOV:75)
# LIMIT    seconds for all of it                          (1500)
set -uo pipefail
cd "$(dirname "$0")/.."

[ -n "${PYTHON:-}" ] || { PYTHON=python3 && [ -x .venv/bin/python ] && PYTHON=.venv/bin/python; }
WHEELS=${WHEELS:-wheels}
OUT=${OUT:-results/gpu}
STUDY=${STUDY:-results/studies/main}
DEMOS=${DEMOS:-results/artifacts/demos/mt50}
SHAPES=${SHAPES:-vla-150m smolvla openvla-7b}
SCALE=${SCALE:-openvla-7b}
EPISODES=${EPISODES:-2}
VIEWS=world.camera.name=corner4+gripperPOV:75
TRAIN=${TRAIN:-train=mt50 train.init=mt50-vision train.scene_steps=0 train.batch=256 $VIEWS}
LIMIT=${LIMIT:-1500}
DEVICE=${DEVICE:-cuda}
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}

mkdir -p "$OUT/studies"
OUT=$(cd "$OUT" && pwd)
began=$SECONDS
failures=0
: >"$OUT/steps.tsv"

left() { echo $((LIMIT - SECONDS + began)); }

# step NAME SECONDS COMMAND…: runs a command for at most so long, and never longer than what is left
step() {
    local name=$1 most=$2 rest start code
    shift 2
    rest=$(left)
    [ "$most" -le "$rest" ] || most=$rest
    if [ "$most" -lt 5 ]; then
        printf '%s\tno time left\n' "$name" | tee -a "$OUT/steps.tsv"
        return
    fi
    start=$SECONDS
    timeout --kill-after=30 "$most" "$@" >"$OUT/$name.log" 2>&1 </dev/null
    code=$?
    # training goes on for as long as there is time and saves its state when it is told to end
    [ "$code" -eq 0 ] || [ "$name:$code" = train:124 ] || failures=$((failures + 1))
    printf '%s\texit %s\t%s s\n' "$name" "$code" $((SECONDS - start)) | tee -a "$OUT/steps.tsv"
}

skip() { printf '%s\tskipped: %s\n' "$1" "$2" | tee -a "$OUT/steps.tsv"; }

kerv() { local name=$1 most=$2; shift 2; step "$name" "$most" "$PYTHON" -m kerv_cli "$@" "results=$OUT" "runtime.device=$DEVICE"; }

missing=$("$PYTHON" - <<'PY'
import importlib.util as found
names = {"altair": "altair", "vl_convert": "vl-convert-python", "filterpy": "filterpy", "gymnasium": "gymnasium",
         "hydra": "hydra-core", "jinja2": "jinja2", "joblib": "joblib", "metaworld": "metaworld", "mujoco": "mujoco", "pandas": "pandas", "PIL": "pillow",
         "numba": "numba", "onnx": "onnx", "onnxruntime": "onnxruntime", "pyarrow": "pyarrow", "pydantic": "pydantic", "yaml": "pyyaml",
         "rich": "rich", "safetensors": "safetensors", "scipy": "scipy", "typer": "typer", "pytest": "pytest", "hypothesis": "hypothesis"}
print(*[package for module, package in names.items() if found.find_spec(module) is None])
PY
) || { echo "gpu.sh: $PYTHON does not run: set PYTHON" >&2; exit 2; }
if [ -n "$missing" ]; then
    [ -d "$WHEELS" ] || { echo "gpu.sh: $missing missing, and no folder of wheels at $WHEELS: set WHEELS" >&2; exit 2; }
    # shellcheck disable=SC2086
    step install 180 "$PYTHON" -m pip install --quiet --no-index --find-links "$WHEELS" $missing
fi
"$PYTHON" -c "import sys, torch; sys.exit(sys.argv[1] == 'cuda' and not torch.cuda.is_available())" "$DEVICE" ||
    { echo "gpu.sh: torch sees no CUDA device with $PYTHON: set PYTHON, or DEVICE=cpu for a trial" >&2; exit 2; }

step tests 240 "$PYTHON" -m pytest -q -p no:cacheprovider tests/test_cuda.py tests/test_waits.py tests/test_program.py
place=0
for shape in $SHAPES; do
    place=$((place + 1))
    kerv "bench-$place-$shape" 180 bench "target=$shape" --json
done
if [ -d "$STUDY" ]; then
    # under a name of its own: the sweep below makes a study named main
    ln -sfn "$(cd "$STUDY" && pwd)" "$OUT/studies/recorded"
    profile=$(ls "$OUT/bench/$SCALE"-*.json 2>/dev/null | head -1)
    step price 240 "$PYTHON" -m kerv_cli report study=recorded "on=$profile" "results=$OUT"
    rm -f "$OUT/studies/recorded"
else
    skip price "no study in $STUDY: run 'kerv sweep study=main', or set STUDY"
fi
kerv sweep 300 sweep study=main task=drawer-open-v3,drawer-close-v3 "episodes=$EPISODES"
if [ -d "$DEMOS" ]; then
    mkdir -p "$OUT/artifacts/demos"
    ln -sfn "$(cd "$DEMOS" && pwd)" "$OUT/artifacts/demos/mt50"
    # shellcheck disable=SC2086
    kerv train "$(left)" train target name=mt50-vision-gpu task=MT50 demos=mt50 $TRAIN
else
    skip train "no demonstrations in $DEMOS: run 'kerv demos task=MT50 name=mt50 $VIEWS', or set DEMOS"
fi
echo "results and logs: $OUT"
[ "$failures" -eq 0 ]
