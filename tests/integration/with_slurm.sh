#!/usr/bin/env bash
# Runs a command with a Slurm of its own, of this machine alone, that lives in a scratch folder and ends with the command:
#     tests/integration/with_slurm.sh srun hostname
# Needs slurmctld, slurmd and munged (Debian: slurm-wlm, munge); touches nothing in /etc and no other Slurm.
set -euo pipefail
PATH=$PATH:/usr/sbin:/sbin
scratch=$(mktemp -d)
host=$(hostname -s)

stop() {
    for name in slurmd slurmctld munged; do
        if [ -s "$scratch/$name.pid" ]; then kill "$(cat "$scratch/$name.pid")" 2>/dev/null || true; fi
    done
    sleep 1 # slurmd still writes into its spool
    rm -rf "$scratch"
}
trap stop EXIT

mkdir "$scratch/state" "$scratch/spool"
chmod 755 "$scratch"
dd if=/dev/urandom of="$scratch/munge.key" bs=128 count=1 status=none
chmod 600 "$scratch/munge.key"
munged --force --socket="$scratch/munge.socket" --key-file="$scratch/munge.key" --pid-file="$scratch/munged.pid" \
    --log-file="$scratch/munged.log" --seed-file="$scratch/munge.seed"

# nproc alone would obey OMP_NUM_THREADS.
cat > "$scratch/slurm.conf" <<END
ClusterName=scratch
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=${SLURMCTLD_PORT:-16817}
SlurmdPort=${SLURMD_PORT:-16818}
AuthType=auth/munge
AuthInfo=socket=$scratch/munge.socket
CredType=cred/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SlurmUser=$(id -un)
SlurmdUser=$(id -un)
StateSaveLocation=$scratch/state
SlurmdSpoolDir=$scratch/spool
SlurmctldPidFile=$scratch/slurmctld.pid
SlurmdPidFile=$scratch/slurmd.pid
SlurmctldLogFile=$scratch/slurmctld.log
SlurmdLogFile=$scratch/slurmd.log
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=sched_interval=5
ReturnToService=2
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(nproc --all) RealMemory=1000 State=UNKNOWN
PartitionName=scratch Nodes=ALL Default=YES MaxTime=INFINITE State=UP
END
export SLURM_CONF=$scratch/slurm.conf
slurmctld
slurmd
for _ in $(seq 60); do
    if [ "$(sinfo --noheader --format=%t 2>/dev/null)" = idle ]; then
        "$@" && exit 0 || exit $?
    fi
    sleep 0.5
done
tail -n 20 "$scratch"/*.log >&2
echo "with_slurm.sh: the node didn't get ready within 30 s" >&2
exit 1
