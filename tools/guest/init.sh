# Process 1 of the guest, run by busybox's shell: `sh init.sh FOLDER`. FOLDER/plan.sh says what differs from run to run:
# the paths image, busybox, modules, terminal, and the functions places and enter.
# Serial lines: ttyS0 is the command's output (or its terminal), ttyS1 its errors, ttyS2 tells of signals.
folder=$1
busybox=$folder/busybox
cd /
. "$folder/plan.sh"

mount() { $busybox mount "$@"; }
mkdir() { $busybox mkdir -p "$@"; }
# A host folder, as it is on the host; below /tmp and /run it would be hidden otherwise.
readable() { mkdir "$1" 2>/dev/null; mount -t hostfs -o "$1" -r none "$1"; }
writable() { mkdir "$1" 2>/dev/null; mount -t hostfs -o "$1" none "$1"; }

mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t devtmpfs dev /dev 2>/dev/null
mkdir /dev/pts /dev/shm
mount -t devpts -o ptmxmode=666 devpts /dev/pts
mount -t tmpfs shm /dev/shm
$busybox cp "$busybox" /dev/busybox # where it was will be hidden
busybox=/dev/busybox
$busybox ln -sf /proc/self/fd /dev/fd
$busybox ln -sf fd/0 /dev/stdin
$busybox ln -sf fd/1 /dev/stdout
$busybox ln -sf fd/2 /dev/stderr
exec 2>/dev/kmsg
mount -t tmpfs run /run
mount -t tmpfs -o mode=1777 tmp /tmp
places
cd /
# With one CPU the real-time processes of a run are most of its load; what is left over need not be set aside for others.
echo -1 >/proc/sys/kernel/sched_rt_runtime_us
# Frames that the kernel delivers late it delivers here, which would wait for all of them.
for process in /proc/[0-9]*; do
  read -r name <"$process/comm"
  if [ "$name" = ksoftirqd/0 ]; then /usr/bin/chrt -f -p 90 "${process#/proc/}"; fi
done

for module in $modules; do $busybox insmod "$module" || failed="kernel module $module"; done
$busybox ip link set lo up
$busybox ip link add dev vcan0 type vcan && $busybox ip link set vcan0 up || failed="vcan0"
mkdir /run/parkctl
if [ -n "$failed" ]; then echo "$failed" >"$folder/failed"; $busybox poweroff -f; fi

# Signals of the host. SIGINT goes to all that the command has started, as from a terminal; the others to it alone.
while read -r number; do
  read -r pid </run/parkctl/pid
  if [ "$number" = 2 ]; then pid=-$pid; fi
  kill -"$number" -- "$pid"
done </dev/ttyS2 &
listener=$!

for line in 0 1 2; do $busybox stty -F /dev/ttyS$line raw -echo; done
echo "$$" >/run/parkctl/pid
if [ -n "$terminal" ]; then
  $busybox stty -F /dev/ttyS0 sane
  $busybox stty -F /dev/ttyS0 $terminal
  : >"$folder/started"
  if [ -n "$errors_apart" ]; then
    $busybox setsid -c $busybox sh "$folder/enter.sh" </dev/ttyS0 >/dev/ttyS0 2>/dev/ttyS1
  else
    $busybox setsid -c $busybox sh "$folder/enter.sh" </dev/ttyS0 >/dev/ttyS0 2>&1
  fi
  status=$?
else
  # Pipes between the command and the lines: it is not to take them for a terminal.
  $busybox mkfifo /run/parkctl/out /run/parkctl/err
  $busybox cat </run/parkctl/out >/dev/ttyS0 &
  out=$!
  $busybox cat </run/parkctl/err >/dev/ttyS1 &
  err=$!
  : >"$folder/started"
  $busybox setsid $busybox sh "$folder/enter.sh" </dev/null >/run/parkctl/out 2>/run/parkctl/err
  status=$?
  # What the command left running would keep the pipes open.
  kill "$listener"
  for process in /proc/[0-9]*; do
    pid=${process#/proc/}
    case $pid in 1 | $out | $err) ;; *) kill -9 "$pid" 2>/dev/null ;; esac
  done
  wait $out $err
fi
for line in 0 1; do $busybox stty -F /dev/ttyS$line raw; done # waits until the line has sent all
echo "$status" >"$folder/status"
$busybox sync
$busybox poweroff -f
