#!/bin/sh
# Brings a CAN interface up as the controller needs it, or down again. Needs root, unless --dry-run only shows the steps.
set -eu

usage() {
  cat <<'TEXT'
usage: can_up.sh [CHANNEL] [options]        CHANNEL: can0 (default), can1, ...; vcan0 is made where it is missing
  --bitrate N       bit/s (500000)
  --restart-ms N    so long after bus-off the controller chip starts again (100; 0: never)
  --txqueuelen N    frames that may wait for the bus (128; the kernel's 10 are fewer than two cycles of this controller)
  --listen-only     the chip does not even acknowledge: for watching a car, with parkctl drive --listen-only
  --down            take the interface down
  --statistics      only show state, error counters and statistics
  --dry-run         show the commands, run none
TEXT
}

fail() {
  echo "can_up: error: $*" >&2
  exit 2
}

number() { # option, value, least, greatest
  case "$2" in '' | *[!0-9]* | ????????*) fail "$1 $2: must be a whole number from $3 to $4" ;; esac
  if [ "$2" -lt "$3" ] || [ "$2" -gt "$4" ]; then fail "$1 $2: must be a whole number from $3 to $4"; fi
}

channel='' bitrate=500000 restart_ms=100 txqueuelen=128 listen_only=off job=up dry=no
while [ $# -gt 0 ]; do
  case "$1" in
    --bitrate | --restart-ms | --txqueuelen)
      [ $# -ge 2 ] || fail "$1: needs a number"
      case "$1" in
        --bitrate) number "$1" "$2" 10000 1000000 && bitrate=$2 ;;
        --restart-ms) number "$1" "$2" 0 60000 && restart_ms=$2 ;;
        --txqueuelen) number "$1" "$2" 1 10000 && txqueuelen=$2 ;;
      esac
      shift ;;
    --listen-only) listen_only=on ;;
    --down) job=down ;;
    --statistics) job=statistics ;;
    --dry-run) dry=yes ;;
    -h | --help) usage; exit 0 ;;
    -*) fail "$1: no such option (see --help)" ;;
    *) [ -z "$channel" ] || fail "$1: one channel at a time, $channel is named already"; channel=$1 ;;
  esac
  shift
done
channel=${channel:-can0}
case "$channel" in *[!a-zA-Z0-9_.-]* | ????????????????*) fail "$channel: not the name of an interface" ;; esac

run() {
  echo "+ $*"
  [ "$dry" = yes ] || "$@" || fail "\`$*\` failed"
}

exists() { [ -e "/sys/class/net/$channel" ]; }

if [ "$dry" = no ]; then
  command -v ip >/dev/null || fail "the program ip is missing (package iproute2)"
  case "$job:$channel" in
    up:vcan*) ;;
    *) exists || fail "$channel: there is no such interface; \`ip link\` lists those that there are" ;;
  esac
  [ "$job" = statistics ] || [ "$(id -u)" -eq 0 ] || fail "needs root; --dry-run shows what would be done"
  if [ "$job" = up ] && command -v modprobe >/dev/null; then
    modprobe -a can can_raw 2>/dev/null || : # may be built in, or loaded by the driver already
  fi
fi

case "$job" in
  up)
    case "$channel" in
      vcan*)
        exists || run ip link add dev "$channel" type vcan ;;
      *)
        # The bit rate can be set only while the interface is down.
        run ip link set dev "$channel" down
        run ip link set dev "$channel" type can bitrate "$bitrate" restart-ms "$restart_ms" listen-only "$listen_only" ;;
    esac
    run ip link set dev "$channel" txqueuelen "$txqueuelen"
    run ip link set dev "$channel" up
    run ip -details -statistics link show dev "$channel"
    # Filters belong to a socket, not to the interface: the controller asks the kernel for the ids of its DBC itself.
    echo "# filters: none here; the controller's own socket passes only the ids of its DBC" ;;
  down)
    run ip link set dev "$channel" down ;;
  statistics)
    run ip -details -statistics link show dev "$channel" ;;
esac
