#!/bin/busybox sh
# The first program of the machine: the host's files, read-only, under a layer in memory; then the tests.
# `share` is the one folder that is the host's and can be written; its file `command` says what to run.
export PATH=/bin
/bin/busybox mkdir -p /proc /sys /dev /host /layer /new
/bin/busybox --install -s /bin
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev

end() {
    echo "machine: $1"
    sync
    poweroff -f
}

for module in virtio_pci 9pnet_virtio 9p overlay; do
    modprobe "$module" || end "no module $module"
done
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,cache=loose,ro host /host || end "no host"
mount -t tmpfs -o size=1g layer /layer
mkdir /layer/upper /layer/work
mount -t overlay -o lowerdir=/host,upperdir=/layer/upper,workdir=/layer/work overlay /new || end "no overlay"
mkdir -p /new/run/machine/share /new/run/machine/modules
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,cache=none share /new/run/machine/share || end "no share"
for place in proc sys dev; do
    mount --move "/$place" "/new/$place"
done
mkdir -p /new/dev/pts /new/dev/shm
mount -t devpts devpts /new/dev/pts
mount -t tmpfs shm /new/dev/shm
mount -t configfs configfs /new/sys/kernel/config 2> /dev/null
cp /bin/busybox /new/run/machine/busybox
ip link set lo up 2> /dev/null

echo "machine: ready"
chroot /new /bin/sh /run/machine/share/command < /dev/null
end "over, code $?"
