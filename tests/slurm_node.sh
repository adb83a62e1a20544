#!/bin/bash
# A Slurm of one node on this machine, for tests:  slurm_node.sh FOLDER [accounting]  …  slurm_node.sh FOLDER stop
# Needs the Debian packages slurm-wlm and munge, with accounting slurmdbd and mariadb-server, and root.
# Then: export SLURM_CONF=FOLDER/slurm.conf
set -euo pipefail
folder=$(realpath -m "$1"); what=${2:-plain}
if [ "$what" = stop ]; then
  for name in slurmd slurmctld slurmdbd mariadbd munged; do
    [ -f "$folder/$name.pid" ] || continue
    pid=$(cat "$folder/$name.pid")
    kill "$pid" 2> /dev/null || continue
    for _ in $(seq 100); do kill -0 "$pid" 2> /dev/null || break; sleep 0.2; done  # its port must be free again
  done
  exit 0
fi
mkdir -p "$folder"/{spool,state,munge}; chmod 711 "$folder"; chmod 755 "$folder/munge"
host=$(hostname -s)
[ -f "$folder/munge.key" ] || dd if=/dev/urandom of="$folder/munge.key" bs=64 count=1 status=none
chmod 600 "$folder/munge.key"
munged --force --key-file="$folder/munge.key" --socket="$folder/munge/socket" --pid-file="$folder/munged.pid" \
  --log-file="$folder/munged.log" --seed-file="$folder/munge.seed"
cat > "$folder/slurm.conf" <<CONF
ClusterName=tests
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=16817
SlurmdPort=16818
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket=$folder/munge/socket
CryptoType=crypto/munge
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
MinJobAge=30
KillWait=15
SchedulerType=sched/backfill
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
JobAcctGatherType=jobacct_gather/none
$( [ "$what" = accounting ] && echo "AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=127.0.0.1
AccountingStoragePort=16819
AccountingStoragePass=$folder/munge/socket" || echo "AccountingStorageType=accounting_storage/none" )
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=1000 State=UNKNOWN
PartitionName=all Nodes=$host Default=YES MaxTime=INFINITE State=UP OverSubscribe=FORCE:4
CONF
export SLURM_CONF="$folder/slurm.conf"
if [ "$what" = accounting ]; then
  mkdir -p "$folder/db"; chown -R mysql "$folder/db"
  [ -d "$folder/db/mysql" ] || mariadb-install-db --user=mysql --datadir="$folder/db" > "$folder/mariadb.log" 2>&1
  mariadbd --no-defaults --user=mysql --datadir="$folder/db" --socket="$folder/db/socket" --port=16820 --bind-address=127.0.0.1 \
    --pid-file="$folder/db/pid" >> "$folder/mariadb.log" 2>&1 &
  echo $! > "$folder/mariadbd.pid"
  for _ in $(seq 60); do mariadb --no-defaults --socket="$folder/db/socket" -e 'select 1' > /dev/null 2>&1 && break; sleep 0.5; done
  mariadb --no-defaults --socket="$folder/db/socket" -e "create database if not exists slurm_acct_db; create user if not exists slurm@127.0.0.1 identified by 'tests'; create user if not exists slurm@localhost identified by 'tests'; grant all on slurm_acct_db.* to slurm@127.0.0.1; grant all on slurm_acct_db.* to slurm@localhost"
  cat > "$folder/slurmdbd.conf" <<CONF
AuthType=auth/munge
AuthInfo=socket=$folder/munge/socket
DbdHost=localhost
DbdAddr=127.0.0.1
DbdPort=16819
SlurmUser=root
LogFile=$folder/slurmdbd.log
PidFile=$folder/slurmdbd.pid
StorageType=accounting_storage/mysql
StorageHost=127.0.0.1
StoragePort=16820
StorageUser=slurm
StoragePass=tests
StorageLoc=slurm_acct_db
CONF
  chmod 600 "$folder/slurmdbd.conf"
  slurmdbd
  for _ in $(seq 60); do sacctmgr -i show cluster > /dev/null 2>&1 && break; sleep 0.5; done
  sacctmgr -i add cluster tests > /dev/null || true
fi
slurmctld -c
slurmd
for _ in $(seq 60); do sinfo -h -o %T 2> /dev/null | grep -Eq 'idle|mixed|alloc' && break; sleep 0.5; done
sinfo
