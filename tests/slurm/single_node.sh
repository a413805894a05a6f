#!/usr/bin/env bash
# A Slurm cluster of one node, this machine, for tests/test_slurm.py. It needs root, and on Debian or Ubuntu it installs
# what is missing. Everything else of it is in one temporary folder; a Slurm that the machine has already is left alone.
#
#   export SLURM_CONF=$(tests/slurm/single_node.sh start)    # the clients find it by this variable
#   tests/slurm/single_node.sh stop                          # reads SLURM_CONF; the logs stay in that folder
set -euo pipefail

fail() {
    echo "no Slurm here: $1" >&2
    exit 1
}

start() {
    [ "$(id -u)" = 0 ] || fail "its daemons need root"
    if ! type slurmctld slurmd munged sbatch >/dev/null 2>&1; then
        command -v apt-get >/dev/null || fail "it is not installed, and there is no apt-get"
        { apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends \
            slurmctld slurmd slurm-client munge; } >&2 || fail "apt-get cannot install it"
    fi
    folder=$(mktemp -d /tmp/single-node-slurm.XXXXXX)
    chmod 755 "$folder"
    mkdir "$folder"/{state,spool,log}
    host=$(hostname -s)

    head -c 1024 /dev/urandom >"$folder/munge.key"
    chmod 600 "$folder/munge.key"
    munged --force --key-file="$folder/munge.key" --socket="$folder/munge.socket" --pid-file="$folder/munged.pid" \
        --log-file="$folder/log/munged" --seed-file="$folder/munged.seed" >&2 || fail "munged does not start"

    # Ports other than Slurm's own. A requeued job waits until its old credential expires, two minutes by default.
    cat >"$folder/slurm.conf" <<CONF
ClusterName=single-node
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=26817
SlurmdPort=26818
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$folder/munge.socket,cred_expire=10
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldLogFile=$folder/log/slurmctld
SlurmdLogFile=$folder/log/slurmd
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=batch_sched_delay=0,sched_interval=5
JobRequeue=1
KillWait=10
ReturnToService=2
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=$(awk '/MemTotal/ {print int($2 / 1024)}' /proc/meminfo)
PartitionName=main Nodes=$host Default=YES MaxTime=INFINITE
CONF
    export SLURM_CONF="$folder/slurm.conf"
    slurmctld >&2 || { stop; fail "slurmctld does not start, see $folder/log"; }
    slurmd >&2 || { stop; fail "slurmd does not start, see $folder/log"; }
    for _ in $(seq 30); do
        if sinfo --noheader --format=%T 2>/dev/null | grep -q idle; then
            echo "$SLURM_CONF"
            return
        fi
        sleep 1
    done
    stop
    fail "the node does not become idle, see $folder/log"
}

stop() {
    folder=$(dirname "${SLURM_CONF:-}")
    case "$folder" in /tmp/single-node-slurm.*) ;; *) fail "SLURM_CONF is not what start printed" ;; esac
    for daemon in slurmd slurmctld munged; do
        [ ! -f "$folder/$daemon.pid" ] || kill "$(cat "$folder/$daemon.pid")" || true
    done
}

case "${1:-}" in
start | stop) "$1" ;;
*)
    echo "usage: $0 start|stop" >&2
    exit 2
    ;;
esac
