#!/bin/sh
# The first process of the virtual machine: the host's files below, read only, a scratch layer above, then the job.
mount -t proc proc /proc; mount -t sysfs sysfs /sys; mount -t devtmpfs dev /dev
for module in /mod/*; do insmod "$module"; done
mount -t 9p -o trans=virtio,version=9p2000.L,msize=1048576,cache=loose,ro host /mnt
mount -t tmpfs tmpfs /tmp; mkdir -p /tmp/upper /tmp/work
mount -t overlay overlay -o lowerdir=/mnt,upperdir=/tmp/upper,workdir=/tmp/work /new
mount -t proc proc /new/proc; mount -t sysfs sysfs /new/sys; mount -t devtmpfs dev /new/dev
mkdir -p /new/dev/pts /new/dev/shm
mount -t devpts devpts /new/dev/pts; mount -t tmpfs tmpfs /new/dev/shm; mount -t tmpfs tmpfs /new/run
mkdir -p /new/vmout
mount -t 9p -o trans=virtio,version=9p2000.L,msize=1048576,cache=none outp /new/vmout
chroot /new /bin/bash /vmout/job.sh
echo o > /proc/sysrq-trigger; sleep 5; poweroff -f
