#!/usr/bin/env bash
# run.sh COMMAND...: boots the kernel that setup.sh made, loads its virtual devices, runs COMMAND in the current folder.
#
# The host's files are there, at their places; what COMMAND writes is lost, except in $OUT. KERNEL_VM_DIR is the
# folder of setup.sh, KERNEL_VM_SECONDS bounds it all (290).
# Exit status: COMMAND's; 75 when the machine did not come up (nothing was tested); 124 when COMMAND did not finish.
set -uo pipefail
[ $# -gt 0 ] || { sed -n '2,6s/^# //p' "$0"; exit 2; }
dir=${KERNEL_VM_DIR:-${XDG_CACHE_HOME:-$HOME/.cache}/diffuserbench/kernel_vm}
[ -e "$dir/initramfs.gz" ] || { echo "no kernel in $dir: run tests/kernel_vm/setup.sh first" >&2; exit 75; }
kernel=$(ls "$dir/img/lib/modules")
out=$dir/out; mkdir -p "$out"
exec 9>"$dir/lock"; flock 9 # one at a time: they share the folder
rm -f "$out/status" "$out/began"

# vivid: input 0 a webcam (discrete sizes and rates), 1 HDMI (cropping); its error injection controls not hidden
modules=("vivid n_devs=1 num_inputs=2 input_types=12 num_outputs=0 node_types=0x1 no_error_inj=0" hid hid-generic uhid usbhid
  cdc-acm dummy_hcd libcomposite usb_f_hid usb_f_acm vhci-hcd)
{
  printf 'export PATH=%q HOME=%q OUT=/vmout LANG=C.UTF-8 DIFFUSERBENCH_KERNEL_VM=1 TMPDIR=/run\n' "$PATH" "$HOME"
  printf 'export MODPROBE=%q\n' "modprobe -d $dir/img -S $kernel"
  # plugins that nothing here uses cost most of pytest's start in there
  printf 'export PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 PYTEST_ADDOPTS="-p pytest_timeout -p no:cacheprovider"\n'
  printf 'cd %q || exit 75\nip link set lo up\n' "$PWD"
  for module in "${modules[@]}"; do printf '$MODPROBE %s || echo "modprobe %s failed"\n' "$module" "${module%% *}"; done
  printf 'mount -t configfs none /sys/kernel/config\ntouch /vmout/began\n'
  printf '%q ' "$@"
  printf '\necho $? > /vmout/status\nsync\n'
} >"$out/job.sh"

# TCG, not KVM: the machines that run this are virtual themselves. Where they are busy the kernel would miss its ten ticks
# and panic: no_timer_check.
timeout "${KERNEL_VM_SECONDS:-290}" qemu-system-x86_64 -accel tcg,thread=multi -cpu max -smp 2 -m 2048 -nographic -no-reboot -nodefaults \
  -serial stdio -monitor none -net none -kernel "$dir/img/boot/vmlinuz-$kernel" -initrd "$dir/initramfs.gz" \
  -append "console=ttyS0 panic=-1 quiet loglevel=3 mitigations=off nokaslr audit=0 no_timer_check" \
  -fsdev local,id=r,path=/,security_model=none,readonly=on,multidevs=remap -device virtio-9p-pci,fsdev=r,mount_tag=host \
  -fsdev local,id=o,path="$out",security_model=none -device virtio-9p-pci,fsdev=o,mount_tag=outp </dev/null 2>&1 |
  sed -u 's/\r//g; s/\x1b[^a-zA-Z]*[a-zA-Z]//g'
if status=$(cat "$out/status" 2>/dev/null); then exit "$status"; fi
if [ -e "$out/began" ]; then echo "the command did not finish in the virtual machine" >&2; exit 124; fi
echo "the virtual machine did not come up" >&2
exit 75
