# Process 1 of the machine with CAN cards: /init of its initramfs, run by busybox, which is all that is there at first.
# /plan.sh says what differs from run to run: modules, the functions places and interfaces, and where enter.sh lies.
export PATH=/bin
mkdir -p /proc /sys /dev /host /root
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t devtmpfs dev /dev
exec </dev/ttyS0 >/dev/ttyS0 2>&1
stty -F /dev/ttyS0 raw -echo
. /plan.sh
for module in $modules; do insmod "/modules/$module" || echo "kernel module $module cannot be loaded"; done
# cache=loose: the host's files do not change meanwhile, and each question over 9p costs a millisecond.
nine() { mount -t 9p -o "trans=virtio,version=9p2000.L,msize=262144,cache=loose,$1" "$2" "$3"; }
nine ro machine /root || { echo "the host's files cannot be mounted"; poweroff -f; }
mount -o bind /root /host # what the places below hide there is still to be had here
for place in proc sys dev; do mount -o bind "/$place" "/root/$place"; done
mkdir -p /root/dev/pts /root/dev/shm
mount -t tmpfs shm /root/dev/shm
ln -sf /proc/self/fd /dev/fd
mount -t tmpfs run /root/run
mount -t tmpfs -o mode=1777 tmp /root/tmp
readable() { mkdir -p "/root$1" 2>/dev/null; mount -o bind "/host$1" "/root$1"; }
writable() { mkdir -p "/root$2" 2>/dev/null; nine rw "$1" "/root$2"; }
places
ip link set lo up
echo -1 >/proc/sys/kernel/sched_rt_runtime_us
: >"/root$folder/started"
chroot /root /bin/sh "$folder/enter.sh" </dev/null
echo "$?" >"/root$folder/status"
sync
poweroff -f
