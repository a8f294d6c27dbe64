#!/usr/bin/env bash
# A campaign as a job array without a scheduler of its own: every task computes one shard, and they fill one
# store. Submit it with the number of shards that you want, and again after anything went wrong:
#
#     STUDY=tmt-segments STORE=/shared/tmt ARGUMENTS="campaign.cases=1000" sbatch --array=0-3 slurm-array.sh
#
#SBATCH --job-name=wavequake
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
#SBATCH --time=01:00:00
#SBATCH --requeue
set -euo pipefail

if [[ ${SLURM_ARRAY_TASK_MIN:-0} != 0 ]]; then
    echo "Shards count from 0: use --array=0-N." >&2
    exit 2
fi
# WAVEQUAKE is the command, where it is not in PATH. Words of WAVEQUAKE and ARGUMENTS are meant to be split.
# shellcheck disable=SC2086
exec ${WAVEQUAKE:-wavequake} run "$STUDY" ${ARGUMENTS:-} --on serial --store "$STORE" \
    --shard "$SLURM_ARRAY_TASK_ID/$((SLURM_ARRAY_TASK_MAX + 1))"
