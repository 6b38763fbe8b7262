"""Any video device of the Linux kernel (Video4Linux 2), by ioctl and mapped buffers."""
