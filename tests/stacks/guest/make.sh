#!/bin/sh
# Makes the machine that `make stacks` emulates: Debian 13 with its kernel, camera stack and Python, and what RHOT needs
# from PyPI. Usage: make.sh FOLDER CONSTRAINTS. Needs root, mmdebstrap, cpio and e2fsprogs.
set -eu
folder=$1
constraints=$2
root=$folder/root
rm -rf "$root" "$folder"/initrd "$folder"/disk.ext4
mkdir -p "$folder"

# gcc and the headers of Python: PiDNG, which picamera2 needs, comes as source.
packages=linux-image-amd64,linux-headers-amd64,dkms,v4l2loopback-dkms,kmod,busybox-static,udev,systemd,systemd-sysv,dbus
packages=$packages,iproute2,procps,v4l-utils,python3,python3-venv,python3-dev,gcc,libc6-dev
packages=$packages,python3-libcamera,python3-prctl,libcamera-ipa,ca-certificates
mmdebstrap --quiet --variant=apt --include="$packages" --aptopt='Acquire::Languages "none"' \
    --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
    --dpkgopt='path-exclude=/usr/share/locale/*' trixie "$root"

# The root fetches as this machine does.
cp /etc/resolv.conf "$root/etc/resolv.conf"
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/ca-certificates.crt"
cp "$constraints" "$root/tmp/constraints.txt"
chroot "$root" python3 -m venv --system-site-packages /opt/rhot
chroot "$root" /opt/rhot/bin/pip install --quiet --disable-pip-version-check --constraint /tmp/constraints.txt \
    cryptography click eclipse-zenoh fpdf2 hypothesis mcap mcap-protobuf-support msgpack numpy opencv-python-headless \
    picamera2 pydantic pyserial pytest pytest-asyncio python-osc pyyaml rich scipy tomlkit trimesh viser websockets
# picamera2 imports KMS++ for its previews on a screen, which is packaged for Raspberry Pi OS alone.
site=$(chroot "$root" /opt/rhot/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
cat > "$root$site/pykms.py" <<'PYKMS'
class _Names(type):
    def __getattr__(cls, name):
        return name


class PixelFormat(metaclass=_Names):
    pass
PYKMS

# Debian's kernel leaves out vimc, the camera that libcamera has a pipeline for: it is built from Debian's own source.
chroot "$root" sh -c '
    set -eu
    cd /tmp
    apt-get update -q > /dev/null
    apt-get download -q linux-source-6.12 > /dev/null
    dpkg-deb --fsys-tarfile linux-source-6.12*.deb | tar x --to-stdout ./usr/src/linux-source-6.12.tar.xz |
        tar xJ linux-source-6.12/drivers/media/test-drivers/vimc
    kernel=$(ls /lib/modules)
    vimc=/tmp/linux-source-6.12/drivers/media/test-drivers/vimc
    make -s -C "/lib/modules/$kernel/build" "M=$vimc" CONFIG_VIDEO_VIMC=m modules 2> /dev/null
    cp "$vimc/vimc.ko" "/lib/modules/$kernel/updates/"
    depmod "$kernel"
    rm -rf /tmp/linux-source* /var/cache/apt/archives/*.deb
'

cat > "$root/init.stacks" <<'INIT'
#!/bin/sh
# First process: mounts, then the job that is shared with this machine, then off.
export PATH=/opt/rhot/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LC_ALL=C.UTF-8 PYTHONPYCACHEPREFIX=/tmp/pycache
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev 2>/dev/null
mkdir -p /dev/shm /dev/pts /share /rhot
for folder in /dev/shm /tmp /run; do mount -t tmpfs tmpfs $folder; done
mount -t devpts pts /dev/pts
mount -t configfs config /sys/kernel/config 2>/dev/null
modprobe -a 9pnet_virtio 9p
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000 share /share
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,cache=loose,ro rhot /rhot
ip link set lo up
/lib/systemd/systemd-udevd --daemon
sh /share/job.sh > /share/output.txt 2>&1
echo $? > /share/status
sync
busybox poweroff -f
INIT
chmod +x "$root/init.stacks"

# The kernel's own first files: what it needs to find its disk.
kernel=$(ls "$root/lib/modules")
cp "$root/boot/vmlinuz-$kernel" "$folder/vmlinuz"
first=$folder/first
rm -rf "$first"
mkdir -p "$first/bin" "$first/modules" "$first/new" "$first/dev"
cp "$root/usr/bin/busybox" "$first/bin/"
for module in virtio_blk virtio_pci ext4; do
    chroot "$root" modprobe --set-version "$kernel" --show-depends "$module" | awk '$1 == "insmod" {print $2}'
done | awk '!seen[$0]++' | while read -r file; do
    name=$(basename "$file" .xz)
    xz -dc "$root$file" > "$first/modules/$name"
    echo "$name" >> "$first/order"
done
cat > "$first/init" <<'INIT'
#!/bin/busybox sh
/bin/busybox mount -t devtmpfs dev /dev
while read -r module; do /bin/busybox insmod "/modules/$module"; done < /order
while [ ! -b /dev/vda ]; do /bin/busybox sleep 0.1; done
/bin/busybox mount -t ext4 /dev/vda /new
exec /bin/busybox switch_root /new "${init:-/init.stacks}"
INIT
chmod +x "$first/init"
(cd "$first" && find . | cpio --create --format=newc --quiet | gzip -1) > "$folder/initrd"
rm -rf "$first"
mke2fs -q -t ext4 -d "$root" -E root_owner=0:0 "$folder/disk.ext4" $(($(du -sm "$root" | cut -f1) * 5 / 4 + 300))M
