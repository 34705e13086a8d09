#!/usr/bin/env bash
# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
#
# On a machine with a GPU, where the package and OpenMM's library for it are installed: do the tests pass, and how fast is it?
# Eight minutes at most; everything goes to a folder.
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

# The tests, all precisions; what there is no time for is left out and said so.
if [ -n "$tests" ]; then
    read -r libraries plugins ours < <(python3 -c '
import pathlib, openmm.version, openmmvrattle
libraries = pathlib.Path(openmm.version.openmm_library_path)
print(libraries, libraries / "plugins", pathlib.Path(openmmvrattle.__file__).parent / "lib")' 2>/dev/null | tail -n 1)
    export OPENMM_PLUGIN_DIR=$plugins LD_LIBRARY_PATH="$ours:$ours/plugins:$libraries:$plugins:${LD_LIBRARY_PATH:-}"
    end=$((SECONDS + test_seconds))
    for precision in ${PRECISIONS:-double mixed single}; do
        for name in Agreement Langevin Thermostats VariableStepRattleIntegrator VariableStepRattleBehaviours LangevinBehaviours Serialization \
            MovingParameters Failures ExpressionConstraints Checks; do
            name=Test${name}GPU
            left=$((end - SECONDS < 45 ? end - SECONDS : 45))
            if [ "$left" -le 0 ]; then
                echo "$name $precision: left out, the time is up" >>"$output/tests.txt"
                continue
            fi
            begin=$SECONDS
            timeout "$left" "$tests/$name" "$platform" "$ours/plugins/libOpenMMVRattle$platform.so" "$precision" \
                >"$output/$name.$precision.txt" 2>&1
            echo "$name $precision: status $?, $((SECONDS - begin)) s, $(tail -n 1 "$output/$name.$precision.txt")" \
                >>"$output/tests.txt"
        done
    done
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
cat "$output/machine.txt" "$output/tests.txt" "$output/gpu.txt" "$output/cpu.txt" 2>/dev/null
exit 0
