#!/bin/sh
# SLURM on one machine, to try it, run by you in a folder of yours: nothing else of the machine changes.
#
#     sudo apt-get install slurm-wlm munge
#     sh docs/how-to/cluster/one_machine.sh start ~/slurm  # writes slurm.conf there and starts munged, slurmctld, slurmd
#     export SLURM_CONF=~/slurm/slurm.conf                     # where sinfo, sbatch and torchmbd find it
#     sh docs/how-to/cluster/one_machine.sh stop ~/slurm
#
# Tried with SLURM 22.05. Ports: 6817 and the next, or those of the variable PORT.
set -eu
action=$1
mkdir -p "$2/state" "$2/spool"
cd "$2"
folder=$(pwd)

stop() {
    for name in slurmd slurmctld munged; do
        [ ! -s $name.pid ] || kill "$(cat $name.pid)" 2>/dev/null || true
    done
}

start() {
    port=${PORT:-6817}
    [ -s munge.key ] || (umask 077 && head -c 1024 /dev/urandom >munge.key)
    cat >slurm.conf <<END
ClusterName=desk
SlurmctldHost=$(hostname -s)(127.0.0.1)
SlurmctldPort=$port
SlurmdPort=$((port + 1))
SlurmUser=$(id -un)
SlurmdUser=$(id -un)
AuthType=auth/munge
AuthInfo=socket=$folder/munge.socket
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
$(/usr/sbin/slurmd -C | head -n 1) NodeAddr=127.0.0.1
PartitionName=desk Nodes=ALL Default=YES State=UP
END
    # --force: the folders above may be writable by others, which munged refuses otherwise
    /usr/sbin/munged --force --key-file="$folder/munge.key" --socket="$folder/munge.socket" \
        --pid-file="$folder/munged.pid" --log-file="$folder/munged.log" --seed-file="$folder/munged.seed"
    SLURM_CONF=$folder/slurm.conf /usr/sbin/slurmctld
    SLURM_CONF=$folder/slurm.conf /usr/sbin/slurmd
}

$action
