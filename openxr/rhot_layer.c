/* An OpenXR API layer that gives every program the hands that RHOT tracks: XR_EXT_hand_tracking with
 * XR_EXT_hand_tracking_data_source and XR_FB_hand_tracking_aim, over any runtime.
 *
 * Hands come from shared memory, see rhot_hands.h. Where the runtime has hands of its own, RHOT's win while they are
 * tracked. A program that does not ask for hands gets the runtime's own functions, and none of this.
 *
 * xrLocateHandJointsEXT neither blocks nor allocates. Sources: the OpenXR specification of the three extensions, and the
 * design of the OpenXR loader for what a layer has to do.
 */
#define _GNU_SOURCE
#include <math.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#include <windows.h>
#define XR_USE_PLATFORM_WIN32
#define EXPORT __declspec(dllexport)
#else
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>
#define XR_USE_TIMESPEC
#define EXPORT __attribute__((visibility("default")))
#endif

#include <openxr/openxr.h>
#include <openxr/openxr_platform.h>
#include <openxr/openxr_loader_negotiation.h> /* from OpenXR 1.0.30 on: Debian 13, Ubuntu 24.04 */

#include "rhot_hands.h"

#define LAYER_NAME "XR_APILAYER_RHOT_hands"
#define JOINTS XR_HAND_JOINT_COUNT_EXT
_Static_assert(JOINTS == RHOT_HANDS_JOINTS, "the joints of XR_EXT_hand_tracking");
_Static_assert(sizeof(RhotHand) == 16 + 56 * RHOT_HANDS_JOINTS, "no padding");

#define SECOND_NS 1000000000LL
#define EXTRAPOLATED_NS 50000000LL /* a hand is carried on with its velocity for so long, either way */
#define STALE_NS 250000000LL       /* a hand that is older is gone: the bridge writes ten times as often */
#define LOOK_NS 500000000LL        /* between two looks for a bridge that was not there */
#define TRACKERS 16                /* at a time; a program has two */
#define STAGES 64                  /* spaces of a program that are known to rest in the stage */
#define READS 16                   /* of a hand that is being written, until it counts as not tracked */

#define PINCHED_M 0.015f /* thumb and finger closer than this: strength 1 */
#define OPEN_M 0.06f     /* farther than this: 0 */
#define PINCH_SHARE 0.7f /* strength from which on a finger counts as pinching */

static const XrSpaceLocationFlags VALID = XR_SPACE_LOCATION_POSITION_VALID_BIT | XR_SPACE_LOCATION_ORIENTATION_VALID_BIT;
static const XrSpaceLocationFlags TRACKED = XR_SPACE_LOCATION_POSITION_TRACKED_BIT | XR_SPACE_LOCATION_ORIENTATION_TRACKED_BIT;
static const XrSpaceVelocityFlags MOVING = XR_SPACE_VELOCITY_LINEAR_VALID_BIT | XR_SPACE_VELOCITY_ANGULAR_VALID_BIT;

/* What the program asked for, of what this layer has. */
enum { HANDS, SOURCE, AIM, EXTENSIONS };
static const char *const EXTENSION[EXTENSIONS] = {
	XR_EXT_HAND_TRACKING_EXTENSION_NAME,
	XR_EXT_HAND_TRACKING_DATA_SOURCE_EXTENSION_NAME,
	XR_FB_HAND_TRACKING_AIM_EXTENSION_NAME,
};
#ifdef _WIN32
#define TIME_EXTENSION XR_KHR_WIN32_CONVERT_PERFORMANCE_COUNTER_TIME_EXTENSION_NAME
#define TIME_FUNCTION "xrConvertTimeToWin32PerformanceCounterKHR"
typedef PFN_xrConvertTimeToWin32PerformanceCounterKHR ConvertTime;
#else
#define TIME_EXTENSION XR_KHR_CONVERT_TIMESPEC_TIME_EXTENSION_NAME
#define TIME_FUNCTION "xrConvertTimeToTimespecTimeKHR"
typedef PFN_xrConvertTimeToTimespecTimeKHR ConvertTime;
#endif

/* The one instance of this process; the loader allows no second one at the same time. */
static struct {
	XrInstance instance;
	PFN_xrGetInstanceProcAddr next;
	bool wanted[EXTENSIONS];
	bool native; /* the runtime tracks hands, too */
	PFN_xrDestroyInstance destroy_instance;
	PFN_xrDestroySession destroy_session;
	PFN_xrGetSystemProperties get_system_properties;
	PFN_xrCreateReferenceSpace create_space;
	PFN_xrDestroySpace destroy_space;
	PFN_xrLocateSpace locate_space;
	PFN_xrCreateHandTrackerEXT create_tracker;
	PFN_xrDestroyHandTrackerEXT destroy_tracker;
	PFN_xrLocateHandJointsEXT locate_joints;
	ConvertTime convert_time; /* null where the runtime cannot: a hand is then given as it was */
} layer;

/* A tracker's handle is the runtime's own where it has one, so that other extensions of the runtime know it. */
typedef struct Tracker {
	_Atomic uint64_t handle; /* 0: free */
	XrSession session;
	XrSpace stage;
	int side;     /* of RhotHands.hands */
	bool native;  /* the handle is the runtime's */
	bool ours;    /* the program wants bare hands, which RHOT tracks */
} Tracker;
static Tracker trackers[TRACKERS];

/* The program's reference spaces in the stage: where they are needs no question to the runtime, which may be another
 * process. Other spaces, and those beyond the table, are the runtime's to locate. */
static struct {
	_Atomic uint64_t space; /* 0: free, UINT64_MAX: being made */
	XrPosef stage_in_space;
} stages[STAGES];

static uint64_t number_of(XrHandTrackerEXT handle)
{
	uint64_t number = 0;
	memcpy(&number, &handle, sizeof handle);
	return number;
}

static Tracker *find(XrHandTrackerEXT handle)
{
	uint64_t number = number_of(handle);
	for (int i = 0; number && i < TRACKERS; i++)
		if (atomic_load_explicit(&trackers[i].handle, memory_order_acquire) == number)
			return &trackers[i];
	return NULL;
}

/* ---- shared memory ---- */

static _Atomic(const RhotHands *) shared;
static _Atomic int64_t looked_ns; /* when a bridge was last looked for */

#ifdef _WIN32

static int64_t count_ns(LARGE_INTEGER count)
{
	LARGE_INTEGER rate;
	QueryPerformanceFrequency(&rate);
	return count.QuadPart / rate.QuadPart * SECOND_NS + count.QuadPart % rate.QuadPart * SECOND_NS / rate.QuadPart;
}

static int64_t now_ns(void)
{
	LARGE_INTEGER count;
	QueryPerformanceCounter(&count);
	return count_ns(count);
}

static const RhotHands *map_hands(void)
{
	if (atomic_load(&shared))
		return NULL; /* one that is mapped stays the one of its name */
	HANDLE file = OpenFileMappingA(FILE_MAP_READ, FALSE, "Local\\rhot_hands");
	if (!file)
		return NULL;
	const RhotHands *hands = MapViewOfFile(file, FILE_MAP_READ, 0, 0, sizeof *hands);
	CloseHandle(file);
	return hands;
}

#else

static int64_t timespec_ns(struct timespec time)
{
	return time.tv_sec * SECOND_NS + time.tv_nsec;
}

static int64_t now_ns(void)
{
	struct timespec now;
	clock_gettime(CLOCK_MONOTONIC, &now);
	return timespec_ns(now);
}

/* The file, or null: not there, somebody else's, or too small. A mapping is kept for good, since another thread may be
 * reading it; a file that was replaced, which no bridge does, is mapped beside it a few times at most. */
static const RhotHands *map_hands(void)
{
	static _Atomic int64_t mapped_inode;
	static _Atomic int mappings;
	char path[256];
	const char *given = getenv("RHOT_HANDS");
	int length = given ? snprintf(path, sizeof path, "%s", given)
	                   : snprintf(path, sizeof path, "/dev/shm/rhot_hands.%u", (unsigned)getuid());
	if (length < 0 || length >= (int)sizeof path)
		return NULL;
	int file = open(path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
	if (file < 0)
		return NULL;
	struct stat about;
	const RhotHands *hands = NULL;
	if (fstat(file, &about) == 0 && S_ISREG(about.st_mode) && about.st_uid == getuid() && about.st_size >= (off_t)sizeof *hands) {
		if (atomic_load(&shared) && atomic_load(&mapped_inode) == (int64_t)about.st_ino) {
			hands = atomic_load(&shared);
		} else if (atomic_fetch_add(&mappings, 1) < TRACKERS) {
			void *memory = mmap(NULL, sizeof *hands, PROT_READ, MAP_SHARED, file, 0);
			if (memory != MAP_FAILED) {
				hands = memory;
				atomic_store(&mapped_inode, (int64_t)about.st_ino);
			}
		}
	}
	close(file);
	return hands;
}

#endif

/* Look for a bridge that was not there, or whose memory says nothing any more; not more often than twice a second. */
static void look_for_bridge(int64_t now)
{
	int64_t last = atomic_load_explicit(&looked_ns, memory_order_relaxed);
	if (last && now - last < LOOK_NS)
		return;
	if (!atomic_compare_exchange_strong(&looked_ns, &last, now))
		return; /* another thread does */
	const RhotHands *hands = map_hands();
	if (hands)
		atomic_store_explicit(&shared, hands, memory_order_release);
}

/* Copy a hand that is there now; false: no bridge, another version, torn, absent or old.
 *
 * The copy is made word by word with relaxed atomic loads: a plain copy of what another thread writes would be a data
 * race, whatever the sequence says of it afterwards (H. Boehm, "Can seqlocks get along with programming language memory
 * models?", MSPC 2012). */
static bool read_hand(int side, int64_t now, RhotHand *out)
{
	const RhotHands *hands = atomic_load_explicit(&shared, memory_order_acquire);
	if (!hands)
		return false;
	const _Atomic uint32_t *head = (const _Atomic uint32_t *)(const void *)hands;
	if (atomic_load_explicit(&head[0], memory_order_relaxed) != RHOT_HANDS_MAGIC ||
	    atomic_load_explicit(&head[1], memory_order_relaxed) != RHOT_HANDS_VERSION)
		return false;
	const _Atomic uint32_t *words = (const _Atomic uint32_t *)(const void *)&hands->hands[side];
	for (int reads = 0; reads < READS; reads++) {
		uint32_t before = atomic_load_explicit(&words[0], memory_order_acquire);
		if (before & 1)
			continue;
		uint32_t copy[sizeof *out / sizeof(uint32_t)];
		for (size_t i = 0; i < sizeof copy / sizeof *copy; i++)
			copy[i] = atomic_load_explicit(&words[i], memory_order_relaxed);
		atomic_thread_fence(memory_order_acquire);
		if (atomic_load_explicit(&words[0], memory_order_relaxed) != before)
			continue;
		memcpy(out, copy, sizeof copy);
		return (out->state == RHOT_HAND_MEASURED || out->state == RHOT_HAND_PREDICTED) && out->t_ns <= now + STALE_NS &&
		       now - out->t_ns <= STALE_NS;
	}
	return false;
}

/* A broken writer's numbers must not reach a program, which may do anything with them. */
static bool is_sane(const RhotHand *hand)
{
	for (int i = 0; i < JOINTS; i++) {
		const RhotJoint *joint = &hand->joints[i];
		const float *q = joint->orientation, *p = joint->position, *v = joint->linear_velocity, *w = joint->angular_velocity;
		float norm = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
		float far = fmaxf(fmaxf(fabsf(p[0]), fabsf(p[1])), fabsf(p[2]));
		float fast = fabsf(v[0]) + fabsf(v[1]) + fabsf(v[2]) + fabsf(w[0]) + fabsf(w[1]) + fabsf(w[2]);
		/* Each comparison fails for a NaN, which fmaxf alone would swallow. */
		if (!(norm > 0.98f && norm < 1.02f) || !(far < 1000.0f) || !(p[0] + p[1] + p[2] < 3000.0f) || !(fast < 1e4f) ||
		    !(joint->radius >= 0.0f && joint->radius < 0.2f))
			return false;
	}
	return true;
}

/* ---- geometry ---- */

static XrVector3f add(XrVector3f a, XrVector3f b) { return (XrVector3f){a.x + b.x, a.y + b.y, a.z + b.z}; }
static XrVector3f scaled(XrVector3f a, float s) { return (XrVector3f){s * a.x, s * a.y, s * a.z}; }
static XrVector3f vector(const float v[3]) { return (XrVector3f){v[0], v[1], v[2]}; }

static XrVector3f cross(XrVector3f a, XrVector3f b)
{
	return (XrVector3f){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

static XrQuaternionf product(XrQuaternionf a, XrQuaternionf b)
{
	return (XrQuaternionf){
		a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
		a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
		a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
		a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
	};
}

static XrVector3f rotated(XrQuaternionf q, XrVector3f v)
{
	XrVector3f u = {q.x, q.y, q.z}, t = scaled(cross(u, v), 2.0f);
	return add(v, add(scaled(t, q.w), cross(u, t)));
}

/* The rotation vector's quaternion. */
static XrQuaternionf turned(XrVector3f turn)
{
	float angle = sqrtf(turn.x * turn.x + turn.y * turn.y + turn.z * turn.z);
	float s = angle > 1e-6f ? sinf(0.5f * angle) / angle : 0.5f;
	return (XrQuaternionf){s * turn.x, s * turn.y, s * turn.z, cosf(0.5f * angle)};
}

static XrPosef inverse(XrPosef pose)
{
	XrQuaternionf q = {-pose.orientation.x, -pose.orientation.y, -pose.orientation.z, pose.orientation.w};
	return (XrPosef){q, scaled(rotated(q, pose.position), -1.0f)};
}

/* Carry a hand on for some seconds with its velocities. */
static void extrapolate(RhotHand *hand, float seconds)
{
	for (int i = 0; i < JOINTS; i++) {
		RhotJoint *joint = &hand->joints[i];
		for (int axis = 0; axis < 3; axis++)
			joint->position[axis] += seconds * joint->linear_velocity[axis];
		const float *o = joint->orientation;
		XrQuaternionf turn = turned(scaled(vector(joint->angular_velocity), seconds));
		XrQuaternionf q = product(turn, (XrQuaternionf){o[0], o[1], o[2], o[3]});
		memcpy(joint->orientation, &q, sizeof joint->orientation);
	}
}

/* ---- what a program calls ---- */

/* The structure of a type in a chain, or null. */
static void *chained(const void *next, XrStructureType type)
{
	for (const XrBaseInStructure *s = next; s; s = s->next)
		if (s->type == type)
			return (void *)(uintptr_t)s;
	return NULL;
}

static XRAPI_ATTR XrResult XRAPI_CALL get_system_properties(XrInstance instance, XrSystemId system, XrSystemProperties *properties)
{
	XrResult result = layer.get_system_properties(instance, system, properties);
	if (XR_SUCCEEDED(result)) {
		XrSystemHandTrackingPropertiesEXT *hands = chained(properties->next, XR_TYPE_SYSTEM_HAND_TRACKING_PROPERTIES_EXT);
		if (hands) {
			layer.native = layer.native && hands->supportsHandTracking;
			hands->supportsHandTracking = XR_TRUE;
		}
	}
	return result;
}

static XRAPI_ATTR XrResult XRAPI_CALL create_space(XrSession session, const XrReferenceSpaceCreateInfo *info, XrSpace *out)
{
	XrResult result = layer.create_space(session, info, out);
	if (XR_FAILED(result) || info->referenceSpaceType != XR_REFERENCE_SPACE_TYPE_STAGE)
		return result;
	for (int i = 0; i < STAGES; i++) {
		uint64_t none = 0;
		if (atomic_compare_exchange_strong(&stages[i].space, &none, UINT64_MAX)) {
			stages[i].stage_in_space = inverse(info->poseInReferenceSpace);
			atomic_store_explicit(&stages[i].space, (uint64_t)(uintptr_t)*out, memory_order_release);
			break;
		}
	}
	return result;
}

static XRAPI_ATTR XrResult XRAPI_CALL destroy_space(XrSpace space)
{
	for (int i = 0; i < STAGES; i++) {
		uint64_t number = (uint64_t)(uintptr_t)space;
		atomic_compare_exchange_strong(&stages[i].space, &number, 0);
	}
	return layer.destroy_space(space);
}

/* Where the stage is in a program's space. */
static XrResult locate_stage(const Tracker *tracker, XrSpace space, XrTime time, XrSpaceLocation *out)
{
	if (time <= 0)
		return XR_ERROR_TIME_INVALID;
	for (int i = 0; i < STAGES; i++)
		if (atomic_load_explicit(&stages[i].space, memory_order_acquire) == (uint64_t)(uintptr_t)space && space) {
			XrSpaceVelocity *velocity = out->next;
			out->pose = stages[i].stage_in_space;
			out->locationFlags = VALID | TRACKED;
			if (velocity)
				velocity->velocityFlags = MOVING;
			return XR_SUCCESS;
		}
	return layer.locate_space(tracker->stage != XR_NULL_HANDLE ? tracker->stage : space, space, time, out);
}

/* Whether a program that names its data sources wants bare hands. */
static bool wants_bare_hands(const XrHandTrackerCreateInfoEXT *info)
{
	const XrHandTrackingDataSourceInfoEXT *sources = chained(info->next, XR_TYPE_HAND_TRACKING_DATA_SOURCE_INFO_EXT);
	if (!layer.wanted[SOURCE] || !sources)
		return true;
	for (uint32_t i = 0; i < sources->requestedDataSourceCount; i++)
		if (sources->requestedDataSources[i] == XR_HAND_TRACKING_DATA_SOURCE_UNOBSTRUCTED_EXT)
			return true;
	return false;
}

static void release(Tracker *tracker)
{
	tracker->session = XR_NULL_HANDLE;
	atomic_store_explicit(&tracker->handle, 0, memory_order_release);
}

static XRAPI_ATTR XrResult XRAPI_CALL create_tracker(XrSession session, const XrHandTrackerCreateInfoEXT *info, XrHandTrackerEXT *out)
{
	if (!info || info->type != XR_TYPE_HAND_TRACKER_CREATE_INFO_EXT || !out)
		return XR_ERROR_VALIDATION_FAILURE;
	if (info->hand != XR_HAND_LEFT_EXT && info->hand != XR_HAND_RIGHT_EXT)
		return XR_ERROR_VALIDATION_FAILURE;
	XrHandTrackerEXT handle = XR_NULL_HANDLE;
	bool native = layer.native && XR_SUCCEEDED(layer.create_tracker(session, info, &handle));
	if (!native && info->handJointSet != XR_HAND_JOINT_SET_DEFAULT_EXT)
		return XR_ERROR_FEATURE_UNSUPPORTED;
	Tracker *tracker = NULL;
	for (int i = 0; !tracker && i < TRACKERS; i++) {
		uint64_t none = 0;
		if (atomic_compare_exchange_strong(&trackers[i].handle, &none, UINT64_MAX))
			tracker = &trackers[i];
	}
	XrResult result = tracker ? XR_SUCCESS : XR_ERROR_LIMIT_REACHED;
	if (tracker) {
		XrReferenceSpaceCreateInfo stage = {XR_TYPE_REFERENCE_SPACE_CREATE_INFO, NULL, XR_REFERENCE_SPACE_TYPE_STAGE, {{0, 0, 0, 1}, {0, 0, 0}}};
		tracker->stage = XR_NULL_HANDLE;
		result = layer.create_space(session, &stage, &tracker->stage);
		/* A runtime without a floor still has hands, if not RHOT's. */
		if (result == XR_ERROR_REFERENCE_SPACE_UNSUPPORTED)
			result = XR_SUCCESS;
		if (XR_FAILED(result))
			release(tracker);
	}
	if (XR_FAILED(result)) {
		if (native)
			layer.destroy_tracker(handle);
		return result;
	}
	tracker->session = session;
	tracker->side = info->hand == XR_HAND_RIGHT_EXT;
	tracker->native = native;
	tracker->ours = tracker->stage != XR_NULL_HANDLE && info->handJointSet == XR_HAND_JOINT_SET_DEFAULT_EXT && wants_bare_hands(info);
	if (!native)
		handle = (XrHandTrackerEXT)(uintptr_t)tracker;
	atomic_store_explicit(&tracker->handle, number_of(handle), memory_order_release);
	look_for_bridge(now_ns());
	*out = handle;
	return XR_SUCCESS;
}

static XRAPI_ATTR XrResult XRAPI_CALL destroy_tracker(XrHandTrackerEXT handle)
{
	Tracker *tracker = find(handle);
	if (!tracker)
		return XR_ERROR_HANDLE_INVALID;
	if (tracker->stage != XR_NULL_HANDLE)
		layer.destroy_space(tracker->stage);
	bool native = tracker->native;
	release(tracker);
	return native ? layer.destroy_tracker(handle) : XR_SUCCESS;
}

/* The runtime ends what belongs to a session; so do we. */
static XRAPI_ATTR XrResult XRAPI_CALL destroy_session(XrSession session)
{
	for (int i = 0; i < TRACKERS; i++)
		if (atomic_load_explicit(&trackers[i].handle, memory_order_acquire) && trackers[i].session == session)
			release(&trackers[i]);
	/* Of which session a space was is not noted: those of another are asked of the runtime from here on. */
	for (int i = 0; i < STAGES; i++)
		atomic_store(&stages[i].space, 0);
	return layer.destroy_session(session);
}

static XRAPI_ATTR XrResult XRAPI_CALL destroy_instance(XrInstance instance)
{
	for (int i = 0; i < TRACKERS; i++)
		release(&trackers[i]);
	for (int i = 0; i < STAGES; i++)
		atomic_store(&stages[i].space, 0);
	PFN_xrDestroyInstance below = layer.destroy_instance;
	memset(&layer, 0, sizeof layer);
	return below(instance);
}

/* Nanoseconds on the clock of `now_ns` of a program's time; `now` where the runtime cannot say. */
static int64_t machine_ns(XrTime time, int64_t now)
{
	if (!layer.convert_time)
		return now;
#ifdef _WIN32
	LARGE_INTEGER count;
	return XR_FAILED(layer.convert_time(layer.instance, time, &count)) ? now : count_ns(count);
#else
	struct timespec then;
	return XR_FAILED(layer.convert_time(layer.instance, time, &then)) ? now : timespec_ns(then);
#endif
}

/* A hand at a program's time in the stage; false: it is not there. `tracked`: measured, and not carried on too far. */
static bool hand_at(const Tracker *tracker, XrTime time, RhotHand *hand, bool *tracked)
{
	int64_t now = now_ns();
	if (!tracker->ours)
		return false;
	if (!read_hand(tracker->side, now, hand) || !is_sane(hand)) {
		look_for_bridge(now);
		return false;
	}
	int64_t ahead = machine_ns(time, hand->t_ns) - hand->t_ns;
	*tracked = hand->state == RHOT_HAND_MEASURED && llabs(ahead) <= EXTRAPOLATED_NS;
	ahead = ahead > EXTRAPOLATED_NS ? EXTRAPOLATED_NS : ahead < -EXTRAPOLATED_NS ? -EXTRAPOLATED_NS : ahead;
	extrapolate(hand, 1e-9f * (float)ahead);
	return true;
}

/* Pinches and the ray of XR_FB_hand_tracking_aim. The ray leaves from the index finger's knuckle along the palm. */
static void fill_aim(XrHandTrackingAimStateFB *aim, const XrHandJointLocationsEXT *out)
{
	static const XrHandTrackingAimFlagsFB pinching[] = {
		XR_HAND_TRACKING_AIM_INDEX_PINCHING_BIT_FB,
		XR_HAND_TRACKING_AIM_MIDDLE_PINCHING_BIT_FB,
		XR_HAND_TRACKING_AIM_RING_PINCHING_BIT_FB,
		XR_HAND_TRACKING_AIM_LITTLE_PINCHING_BIT_FB,
	};
	static const int tips[] = {XR_HAND_JOINT_INDEX_TIP_EXT, XR_HAND_JOINT_MIDDLE_TIP_EXT, XR_HAND_JOINT_RING_TIP_EXT, XR_HAND_JOINT_LITTLE_TIP_EXT};
	float *strengths[] = {&aim->pinchStrengthIndex, &aim->pinchStrengthMiddle, &aim->pinchStrengthRing, &aim->pinchStrengthLittle};
	aim->status = 0;
	for (int i = 0; i < 4; i++)
		*strengths[i] = 0.0f;
	aim->aimPose = (XrPosef){{0, 0, 0, 1}, {0, 0, 0}};
	if (!out->isActive)
		return;
	const XrHandJointLocationEXT *joints = out->jointLocations;
	XrVector3f thumb = joints[XR_HAND_JOINT_THUMB_TIP_EXT].pose.position;
	aim->status = XR_HAND_TRACKING_AIM_COMPUTED_BIT_FB | XR_HAND_TRACKING_AIM_VALID_BIT_FB;
	for (int i = 0; i < 4; i++) {
		XrVector3f gap = add(joints[tips[i]].pose.position, scaled(thumb, -1.0f));
		float distance = sqrtf(gap.x * gap.x + gap.y * gap.y + gap.z * gap.z);
		float strength = (OPEN_M - distance) / (OPEN_M - PINCHED_M);
		*strengths[i] = strength < 0.0f ? 0.0f : strength > 1.0f ? 1.0f : strength;
		if (*strengths[i] >= PINCH_SHARE)
			aim->status |= pinching[i];
	}
	aim->aimPose.orientation = joints[XR_HAND_JOINT_PALM_EXT].pose.orientation;
	aim->aimPose.position = joints[XR_HAND_JOINT_INDEX_PROXIMAL_EXT].pose.position;
}

static XRAPI_ATTR XrResult XRAPI_CALL locate_joints(XrHandTrackerEXT handle, const XrHandJointsLocateInfoEXT *info, XrHandJointLocationsEXT *out)
{
	const Tracker *tracker = find(handle);
	if (!tracker)
		return XR_ERROR_HANDLE_INVALID;
	if (!info || info->type != XR_TYPE_HAND_JOINTS_LOCATE_INFO_EXT || !out || out->type != XR_TYPE_HAND_JOINT_LOCATIONS_EXT)
		return XR_ERROR_VALIDATION_FAILURE;
	XrHandJointVelocitiesEXT *velocities = chained(out->next, XR_TYPE_HAND_JOINT_VELOCITIES_EXT);
	XrHandTrackingAimStateFB *aim = layer.wanted[AIM] ? chained(out->next, XR_TYPE_HAND_TRACKING_AIM_STATE_FB) : NULL;
	XrHandTrackingDataSourceStateEXT *source =
		layer.wanted[SOURCE] ? chained(out->next, XR_TYPE_HAND_TRACKING_DATA_SOURCE_STATE_EXT) : NULL;
	RhotHand hand;
	bool tracked = false;
	bool there = hand_at(tracker, info->time, &hand, &tracked);
	if (!there && tracker->native) {
		if (aim)
			aim->status = 0; /* for a runtime that does not know these */
		if (source)
			source->isActive = XR_FALSE;
		return layer.locate_joints(handle, info, out);
	}
	if (out->jointCount != JOINTS || !out->jointLocations ||
	    (velocities && (velocities->jointCount != JOINTS || !velocities->jointVelocities)))
		return XR_ERROR_VALIDATION_FAILURE;
	XrSpaceVelocity moving = {XR_TYPE_SPACE_VELOCITY, NULL, 0, {0, 0, 0}, {0, 0, 0}};
	XrSpaceLocation stage = {XR_TYPE_SPACE_LOCATION, velocities ? &moving : NULL, 0, {{0, 0, 0, 1}, {0, 0, 0}}};
	/* Also for a hand that is not there: time and space have to be valid. */
	XrResult result = locate_stage(tracker, info->baseSpace, info->time, &stage);
	if (XR_FAILED(result))
		return result;
	there = there && (stage.locationFlags & VALID) == VALID;
	bool sure = there && tracked && (stage.locationFlags & TRACKED) == TRACKED;
	out->isActive = there ? XR_TRUE : XR_FALSE;
	for (int i = 0; i < JOINTS; i++) {
		XrHandJointLocationEXT *location = &out->jointLocations[i];
		const RhotJoint *joint = &hand.joints[i];
		location->locationFlags = there ? VALID | (sure ? TRACKED : 0) : 0;
		if (velocities)
			velocities->jointVelocities[i].velocityFlags = 0;
		if (!there)
			continue;
		const float *o = joint->orientation;
		XrVector3f from_stage = rotated(stage.pose.orientation, vector(joint->position));
		location->pose.position = add(stage.pose.position, from_stage);
		location->pose.orientation = product(stage.pose.orientation, (XrQuaternionf){o[0], o[1], o[2], o[3]});
		location->radius = joint->radius;
		if (velocities && (moving.velocityFlags & MOVING) == MOVING) {
			XrHandJointVelocityEXT *velocity = &velocities->jointVelocities[i];
			XrVector3f own = rotated(stage.pose.orientation, vector(joint->linear_velocity));
			velocity->velocityFlags = MOVING;
			velocity->linearVelocity = add(add(moving.linearVelocity, cross(moving.angularVelocity, from_stage)), own);
			velocity->angularVelocity =
				add(moving.angularVelocity, rotated(stage.pose.orientation, vector(joint->angular_velocity)));
		}
	}
	if (aim)
		fill_aim(aim, out);
	if (source) {
		source->isActive = out->isActive;
		source->dataSource = XR_HAND_TRACKING_DATA_SOURCE_UNOBSTRUCTED_EXT;
	}
	return XR_SUCCESS;
}

/* ---- the loader's part ---- */

static XRAPI_ATTR XrResult XRAPI_CALL get_proc(XrInstance instance, const char *name, PFN_xrVoidFunction *function)
{
	static const struct {
		const char *name;
		PFN_xrVoidFunction function;
	} own[] = {
		{"xrDestroyInstance", (PFN_xrVoidFunction)destroy_instance},
		{"xrDestroySession", (PFN_xrVoidFunction)destroy_session},
		{"xrGetSystemProperties", (PFN_xrVoidFunction)get_system_properties},
		{"xrCreateReferenceSpace", (PFN_xrVoidFunction)create_space},
		{"xrDestroySpace", (PFN_xrVoidFunction)destroy_space},
		{"xrCreateHandTrackerEXT", (PFN_xrVoidFunction)create_tracker},
		{"xrDestroyHandTrackerEXT", (PFN_xrVoidFunction)destroy_tracker},
		{"xrLocateHandJointsEXT", (PFN_xrVoidFunction)locate_joints},
	};
	if (!layer.next)
		return XR_ERROR_HANDLE_INVALID;
	for (size_t i = 0; layer.wanted[HANDS] && i < sizeof own / sizeof *own; i++)
		if (!strcmp(name, own[i].name)) {
			*function = own[i].function;
			return XR_SUCCESS;
		}
	return layer.next(instance, name, function);
}

static void fetch(XrInstance instance, const char *name, PFN_xrVoidFunction *function)
{
	if (XR_FAILED(layer.next(instance, name, function)))
		*function = NULL;
}

static XRAPI_ATTR XrResult XRAPI_CALL create_instance(const XrInstanceCreateInfo *info, const XrApiLayerCreateInfo *create, XrInstance *out)
{
	XrApiLayerNextInfo *me = create ? create->nextInfo : NULL;
	if (!info || !me || strcmp(me->layerName, LAYER_NAME))
		return XR_ERROR_INITIALIZATION_FAILED;
	XrApiLayerCreateInfo below = *create;
	below.nextInfo = me->next;
	if (me->nextGetInstanceProcAddr == get_proc) /* registered twice: the lower one does the work */
		return me->nextCreateApiLayerInstance(info, &below, out);
	memset(&layer, 0, sizeof layer);
	layer.next = me->nextGetInstanceProcAddr;
	for (uint32_t i = 0; i < info->enabledExtensionCount; i++)
		for (int j = 0; j < EXTENSIONS; j++)
			layer.wanted[j] = layer.wanted[j] || !strcmp(info->enabledExtensionNames[i], EXTENSION[j]);
	if (!layer.wanted[HANDS])
		return me->nextCreateApiLayerInstance(info, &below, out);

	/* Which of these the runtime knows shows in what it accepts: whether it may be asked, loaders and layers disagree. One
	 * more extension tells its clock. */
	static const struct {
		bool has[EXTENSIONS], time;
	} offers[] = {
		{{true, true, true}, true}, {{true, true, false}, true}, {{true, false, false}, true},
		{{false, false, false}, true}, {{false, false, false}, false},
	};
	const char **kept = calloc(info->enabledExtensionCount + 1, sizeof *kept);
	if (!kept)
		return XR_ERROR_OUT_OF_MEMORY;
	XrInstanceCreateInfo passed = *info;
	passed.enabledExtensionNames = kept;
	XrResult result = XR_ERROR_EXTENSION_NOT_PRESENT;
	bool has_hands = false;
	for (size_t offer = 0; result == XR_ERROR_EXTENSION_NOT_PRESENT && offer < sizeof offers / sizeof *offers; offer++) {
		bool enabled_time = false;
		passed.enabledExtensionCount = 0;
		for (uint32_t i = 0; i < info->enabledExtensionCount; i++) {
			const char *name = info->enabledExtensionNames[i];
			bool lacking = false;
			for (int j = 0; j < EXTENSIONS; j++)
				lacking = lacking || (!offers[offer].has[j] && !strcmp(name, EXTENSION[j]));
			enabled_time = enabled_time || !strcmp(name, TIME_EXTENSION);
			if (!lacking)
				kept[passed.enabledExtensionCount++] = name;
		}
		if (offers[offer].time && !enabled_time)
			kept[passed.enabledExtensionCount++] = TIME_EXTENSION;
		has_hands = offers[offer].has[HANDS];
		result = me->nextCreateApiLayerInstance(&passed, &below, out);
	}
	free((void *)kept);
	if (XR_FAILED(result))
		return result;
	layer.instance = *out;
	fetch(*out, "xrDestroyInstance", (PFN_xrVoidFunction *)&layer.destroy_instance);
	fetch(*out, "xrDestroySession", (PFN_xrVoidFunction *)&layer.destroy_session);
	fetch(*out, "xrGetSystemProperties", (PFN_xrVoidFunction *)&layer.get_system_properties);
	fetch(*out, "xrCreateReferenceSpace", (PFN_xrVoidFunction *)&layer.create_space);
	fetch(*out, "xrDestroySpace", (PFN_xrVoidFunction *)&layer.destroy_space);
	fetch(*out, "xrLocateSpace", (PFN_xrVoidFunction *)&layer.locate_space);
	fetch(*out, TIME_FUNCTION, (PFN_xrVoidFunction *)&layer.convert_time);
	if (has_hands) {
		fetch(*out, "xrCreateHandTrackerEXT", (PFN_xrVoidFunction *)&layer.create_tracker);
		fetch(*out, "xrDestroyHandTrackerEXT", (PFN_xrVoidFunction *)&layer.destroy_tracker);
		fetch(*out, "xrLocateHandJointsEXT", (PFN_xrVoidFunction *)&layer.locate_joints);
		layer.native = layer.create_tracker && layer.destroy_tracker && layer.locate_joints;
	}
	return XR_SUCCESS;
}

EXPORT XRAPI_ATTR XrResult XRAPI_CALL xrNegotiateLoaderApiLayerInterface(const XrNegotiateLoaderInfo *loader, const char *name,
                                                                         XrNegotiateApiLayerRequest *request)
{
	if (!loader || !request || (name && strcmp(name, LAYER_NAME)) || loader->structType != XR_LOADER_INTERFACE_STRUCT_LOADER_INFO ||
	    loader->structSize != sizeof *loader || request->structType != XR_LOADER_INTERFACE_STRUCT_API_LAYER_REQUEST ||
	    request->structSize != sizeof *request || loader->minInterfaceVersion > XR_CURRENT_LOADER_API_LAYER_VERSION ||
	    loader->maxInterfaceVersion < XR_CURRENT_LOADER_API_LAYER_VERSION)
		return XR_ERROR_INITIALIZATION_FAILED;
	request->layerInterfaceVersion = XR_CURRENT_LOADER_API_LAYER_VERSION;
	request->layerApiVersion = XR_MAKE_VERSION(1, 0, 0); /* it uses nothing newer */
	request->getInstanceProcAddr = get_proc;
	request->createApiLayerInstance = create_instance;
	return XR_SUCCESS;
}
