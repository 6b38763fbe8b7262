#!/usr/bin/env bash
# setup.sh [DIR]: Debian's kernel, QEMU and an initramfs into DIR, once (default: a folder in the user's cache).
#
# Needs root and apt, for packages only; nothing but DIR is written otherwise. Run again, it does nothing.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
dir=${1:-${XDG_CACHE_HOME:-$HOME/.cache}/diffuserbench/kernel_vm}
mkdir -p "$dir" && cd "$dir"
stamp=ready-$(cat "$here/setup.sh" "$here/init.sh" | sha256sum | cut -c1-16)
if [ -e "$stamp" ] && command -v qemu-system-x86_64 >/dev/null; then exit 0; fi
rm -f ready-*

export DEBIAN_FRONTEND=noninteractive
packages=(qemu-system-x86 qemu-system-common ipxe-qemu seabios busybox-static cpio kmod xz-utils iproute2)
install() { apt-get -o DPkg::Lock::Timeout=120 install -y --no-install-recommends "${packages[@]}" >>apt.log 2>&1; }
: >apt.log
install || { apt-get update >>apt.log 2>&1 && install; } || { tail -5 apt.log >&2; exit 1; }

if [ ! -d img/lib/modules ]; then
  rm -rf img linux-image-*.deb
  kernel_package() { apt-cache depends linux-image-amd64 2>/dev/null | awk '/Depends: linux-image/{print $2; exit}'; }
  [ -n "$(kernel_package)" ] || apt-get update >>apt.log 2>&1
  apt-get download "$(kernel_package)" >>apt.log 2>&1 || { tail -5 apt.log >&2; exit 1; }
  dpkg -x linux-image-*.deb img.part && mv img.part img && rm -f linux-image-*.deb
fi
kernel=$(ls img/lib/modules)
depmod -b img "$kernel"

# The initramfs holds what is needed to see the host's file system: busybox and the modules of virtio and 9p.
rm -rf initramfs && mkdir -p initramfs/{bin,proc,sys,dev,mnt,new,mod,tmp}
cp /bin/busybox initramfs/bin/
for applet in sh mount insmod mkdir chroot poweroff sleep; do ln -s busybox "initramfs/bin/$applet"; done
n=0
for module in virtio_pci 9pnet_virtio 9p overlay; do
  modprobe -d "$dir/img" -S "$kernel" --show-depends "$module" | awk '/^insmod/{print $2}'
done | awk '!seen[$0]++' | while read -r file; do
  cp "$file" "initramfs/mod/$(printf %02d $n)-$(basename "$file")"
  n=$((n + 1))
done
cp "$here/init.sh" initramfs/init && chmod +x initramfs/init
(cd initramfs && find . | cpio -o -H newc --quiet | gzip -1) >initramfs.gz
touch "$stamp"
echo "ready: Linux $kernel in $dir"
