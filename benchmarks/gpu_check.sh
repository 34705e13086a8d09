#!/usr/bin/env bash
# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
#
# On a machine with a GPU, where the package and OpenMM's library for it are installed: do the tests pass, and how fast is it?
# Seven minutes at most; everything goes to a folder.
#
#     benchmarks/gpu_check.sh OUTPUT [PLATFORM [DATA [TESTS]]]
#
# PLATFORM is CUDA (default), HIP or OpenCL. DATA is as in benchmarks/gpu.py. TESTS is a folder with the programs Test*GPU that a
# build of the C++ tests leaves in build/platforms/common.
set -uo pipefail

output=${1:?a folder for the results} platform=${2:-CUDA} data=${3:-} tests=${4:-}
here=$(cd "$(dirname "$0")" && pwd)
test_seconds=${TEST_SECONDS:-170} speed_seconds=${SPEED_SECONDS:-170} cpu_seconds=${CPU_SECONDS:-60}
mkdir -p "$output"
{
    date -u
    nvidia-smi --query-gpu=name,driver_version --format=csv,noheader 2>/dev/null
    nproc
    timeout 60 python3 -m openmmvrattle info
} >"$output/machine.txt" 2>&1

# The tests, each by itself and as many at once as there are processors: most of their time is compilation. All of them in double
# precision; in the others those that allow for their rounding.
if [ -n "$tests" ]; then
    read -r libraries plugins ours < <(python3 -c '
import pathlib, openmm.version, openmmvrattle
libraries = pathlib.Path(openmm.version.openmm_library_path)
print(libraries, libraries / "plugins", pathlib.Path(openmmvrattle.__file__).parent / "lib")' 2>/dev/null | tail -n 1)
    export OPENMM_PLUGIN_DIR=$plugins LD_LIBRARY_PATH="$ours:$ours/plugins:$libraries:$plugins:${LD_LIBRARY_PATH:-}"
    end=$(($(date +%s) + test_seconds))
    export platform tests output end library="$ours/plugins/libOpenMMVRattle$platform.so"
    mkdir -p "$output/tests"
    run_test() {
        local left=$((end - $(date +%s)))
        [ "$left" -gt 0 ] || return 0
        timeout "$left" "$tests/Test$1GPU" "$platform" "$library" "$2" "$3" >"$output/tests/$1.$2.$3.txt" 2>&1
        echo "$1 $2 $3: status $?, $(grep -m 1 '^passed:\|^FAILED:' "$output/tests/$1.$2.$3.txt")" >>"$output/tests.txt"
    }
    export -f run_test
    for each in $(ls -r "$tests" | sed -n 's/^Test\(.*\)GPU$/\1/p') "Agreement mixed" "Agreement single" "Failures mixed"; do # the longest first
        read -r name precision <<<"$each"
        for number in $(seq 0 $(($("$tests/Test${name}GPU" "" "" "" count) - 1))); do
            echo "$name ${precision:-double} $number"
        done
    done >"$output/tests/all"
    xargs -a "$output/tests/all" -P "$(nproc)" -L 1 bash -c 'run_test "$@"' _
    echo "$(grep -c 'status 0' "$output/tests.txt") of $(wc -l <"$output/tests/all") tests passed" >>"$output/machine.txt"
    grep -v 'status 0' "$output/tests.txt" >>"$output/machine.txt"
fi

# The speed. The order is that of importance.
speed() {
    timeout $((speed_seconds + 60)) python3 "$here/gpu.py" --platform "$platform" ${data:+--data "$data"} \
        --output "$output/gpu.jsonl" "$@" >>"$output/gpu.txt" 2>&1
}
begin=$SECONDS
protein=villin
[ -n "$data" ] && protein=dhfr
speed --precision mixed --system ${SYSTEMS:-water24k $protein water6k water96k} --energy ${ENERGY-water6k $protein} --budget "$speed_seconds" ${OPTIONS:-}
left=$((speed_seconds - SECONDS + begin))
[ "$left" -gt 15 ] && speed --precision mixed --system ${SYSTEMS:-$protein-allbonds} --tolerance 1e-6 --calls 1000 --rounds 3 --budget "$left" ${OPTIONS:-}
left=$((speed_seconds - SECONDS + begin))
[ "$left" -gt 15 ] && speed --precision single double --system ${SYSTEMS:-water24k} --calls 1000 --rounds 3 --budget "$left" ${OPTIONS:-}

# The platform CPU on all processors.
timeout "$cpu_seconds" python3 "$here/gpu.py" --platform CPU --threads "$(nproc)" ${data:+--data "$data"} \
    --system ${SYSTEMS:-water24k} --integrator Verlet Explicit SemiExplicit --calls 10 --rounds 9 --seconds 0.3 --equilibrate 50 \
    --output "$output/gpu.jsonl" >"$output/cpu.txt" 2>&1
cat "$output/machine.txt" "$output/gpu.txt" "$output/cpu.txt" 2>/dev/null
exit 0
