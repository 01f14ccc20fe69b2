/* A runtime for the OpenVR client library: the client loads it as it loads SteamVR's, and gets devices that the test
 * sets. Only IVRSystem is there, and of it what RHOT asks.
 *
 * Structures, numbers and the order of functions are those of openvr.h and openvr_capi.h (IVRSystem_023). */
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

enum { DEVICES = 64, EVENTS = 16, FUNCTIONS = 47 };
enum { INIT_NONE = 0, INIT_NO_SERVER = 121, INIT_INTERFACE_NOT_FOUND = 105 };
enum { PROPERTY_SUCCESS = 0, PROPERTY_BUFFER_TOO_SMALL = 3, PROPERTY_UNKNOWN = 4, PROPERTY_INVALID_DEVICE = 5 };
enum { SERIAL_NUMBER = 1002, CURRENT_UNIVERSE = 2004 };
enum { RESULT_RUNNING_OK = 200, RESULT_OUT_OF_RANGE = 201 };

typedef struct { float m[3][4]; } Matrix34;
typedef struct { Matrix34 pose; float velocity[3], angular_velocity[3]; int32_t result; bool valid, connected; } Pose;
typedef struct { uint32_t type, device; float age_s; uint8_t data[64]; } Event;
typedef struct { bool connected, valid; int32_t kind; char serial[64]; Matrix34 pose; } Device;

static Device devices[DEVICES];
static Event events[EVENTS];
static int event_count, quits_acknowledged;
static uint64_t universe = 1;
static Matrix34 raw_to_standing = {{{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 1, 0}}};
static bool server = true;

/* What the test sets. */
void test_device(uint32_t index, bool connected, bool valid, int32_t kind, const char *serial, const float *pose) {
    Device *device = &devices[index];
    device->connected = connected;
    device->valid = valid;
    device->kind = kind;
    strncpy(device->serial, serial, sizeof device->serial - 1);
    memcpy(device->pose.m, pose, sizeof device->pose.m);
}
void test_space(uint64_t id, const float *matrix) {
    universe = id;
    memcpy(raw_to_standing.m, matrix, sizeof raw_to_standing.m);
}
void test_event(uint32_t type) {
    if (event_count < EVENTS) events[event_count++] = (Event){.type = type};
}
void test_server(bool runs) { server = runs; }
int test_quits_acknowledged(void) { return quits_acknowledged; }

/* IVRSystem */
static void poses(int32_t origin, float ahead_s, Pose *out, uint32_t count) {
    (void)origin, (void)ahead_s;
    for (uint32_t k = 0; k < count && k < DEVICES; k++) {
        memset(&out[k], 0, sizeof out[k]);
        if (!server || !devices[k].connected) continue;
        out[k].pose = devices[k].pose;
        out[k].connected = true;
        out[k].valid = devices[k].valid;
        out[k].result = devices[k].valid ? RESULT_RUNNING_OK : RESULT_OUT_OF_RANGE;
    }
}
static Matrix34 raw_zero_pose(void) { return raw_to_standing; }
static int32_t device_class(uint32_t k) { return k < DEVICES && devices[k].connected ? devices[k].kind : 0; }
static uint64_t uint64_property(uint32_t k, int32_t property, int32_t *error) {
    (void)k;
    *error = property == CURRENT_UNIVERSE ? PROPERTY_SUCCESS : PROPERTY_UNKNOWN;
    return universe;
}
static uint32_t string_property(uint32_t k, int32_t property, char *out, uint32_t size, int32_t *error) {
    if (k >= DEVICES || !devices[k].connected) {
        *error = PROPERTY_INVALID_DEVICE;
        return 0;
    }
    if (property != SERIAL_NUMBER || devices[k].serial[0] == 0) {
        *error = PROPERTY_UNKNOWN;
        return 0;
    }
    uint32_t needed = (uint32_t)strlen(devices[k].serial) + 1;
    *error = size < needed ? PROPERTY_BUFFER_TOO_SMALL : PROPERTY_SUCCESS;
    if (size >= needed) memcpy(out, devices[k].serial, needed);
    return needed;
}
static bool next_event(Event *out, uint32_t size) {
    if (event_count == 0 || size < 12) return false;
    memcpy(out, &events[0], size < sizeof *out ? size : sizeof *out);
    memmove(&events[0], &events[1], (size_t)--event_count * sizeof events[0]);
    return true;
}
static void acknowledge_quit(void) { quits_acknowledged++; }

/* Places in the table of functions, counted from 0. */
static void *table[FUNCTIONS] = {
    [11] = (void *)poses,         [13] = (void *)raw_zero_pose, [19] = (void *)device_class, [24] = (void *)uint64_property,
    [27] = (void *)string_property, [29] = (void *)next_event, [44] = (void *)acknowledge_quit,
};

/* IVRClientCore_003, whose table is that of a C++ class without data. */
static int32_t core_init(void *self, int32_t kind, const char *info) {
    (void)self, (void)kind, (void)info;
    return server ? INIT_NONE : INIT_NO_SERVER;
}
static void core_cleanup(void *self) { (void)self; }
static int32_t core_is_valid(void *self, const char *version) {
    (void)self;
    return strstr(version, "IVRSystem_") ? INIT_NONE : INIT_INTERFACE_NOT_FOUND;
}
static void *core_interface(void *self, const char *name, int32_t *error) {
    (void)self;
    bool known = strcmp(name, "FnTable:IVRSystem_023") == 0;
    *error = known ? INIT_NONE : INIT_INTERFACE_NOT_FOUND;
    return known ? table : 0;
}
static bool core_present(void *self) { return (void)self, true; }
static const char *core_text(void *self, int32_t error) { return (void)self, (void)error, "of the test's runtime"; }
static void *core_table[] = {
    (void *)core_init,    (void *)core_cleanup, (void *)core_is_valid, (void *)core_interface,
    (void *)core_present, (void *)core_text,    (void *)core_text,
};
static struct { void **functions; } core = {core_table};

void *VRClientCoreFactory(const char *name, int *error) {
    bool known = strcmp(name, "IVRClientCore_003") == 0;
    if (error) *error = known ? INIT_NONE : INIT_INTERFACE_NOT_FOUND;
    return known ? &core : 0;
}
