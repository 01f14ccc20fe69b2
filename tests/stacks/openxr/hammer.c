/* The layer with a runtime of its own and a bridge that dies at random, in one process for the sanitizers.
 *
 * Usage: hammer CALLS. Two threads locate the right hand; a third writes it as `rhot bridge openxr` does, and now and then
 * stops in the middle of a write for a while, as a killed bridge would. All numbers of one write are the same, so that a
 * torn read shows. Says `calls … tracked … allocations … median …`.
 */
#include "rhot_layer.c"

#include <pthread.h>

static _Atomic long allocations;
void *__real_malloc(size_t size);
void *__real_calloc(size_t count, size_t size);
void *__wrap_malloc(size_t size)
{
	allocations++;
	return __real_malloc(size);
}
void *__wrap_calloc(size_t count, size_t size)
{
	allocations++;
	return __real_calloc(count, size);
}

/* ---- a runtime that knows a stage and no hands ---- */

static XRAPI_ATTR XrResult XRAPI_CALL make_space(XrSession session, const XrReferenceSpaceCreateInfo *info, XrSpace *out)
{
	static _Atomic uintptr_t spaces = 100;
	(void)session, (void)info;
	*out = (XrSpace)++spaces;
	return XR_SUCCESS;
}

static XRAPI_ATTR XrResult XRAPI_CALL end_space(XrSpace space) { return space ? XR_SUCCESS : XR_ERROR_HANDLE_INVALID; }
static XRAPI_ATTR XrResult XRAPI_CALL end_session(XrSession session) { return session ? XR_SUCCESS : XR_ERROR_HANDLE_INVALID; }
static XRAPI_ATTR XrResult XRAPI_CALL end_instance(XrInstance instance) { return instance ? XR_SUCCESS : XR_ERROR_HANDLE_INVALID; }

static XRAPI_ATTR XrResult XRAPI_CALL place(XrSpace space, XrSpace base, XrTime time, XrSpaceLocation *out)
{
	(void)space, (void)base, (void)time;
	out->locationFlags = VALID | TRACKED;
	out->pose = (XrPosef){{0, 0, 0, 1}, {0, 0, 0}};
	return XR_SUCCESS;
}

static XRAPI_ATTR XrResult XRAPI_CALL to_timespec(XrInstance instance, XrTime time, struct timespec *out)
{
	(void)instance;
	*out = (struct timespec){time / SECOND_NS, time % SECOND_NS};
	return XR_SUCCESS;
}

static XRAPI_ATTR XrResult XRAPI_CALL properties(XrInstance instance, XrSystemId system, XrSystemProperties *out)
{
	(void)instance, (void)system, (void)out;
	return XR_SUCCESS;
}

static XRAPI_ATTR XrResult XRAPI_CALL runtime_proc(XrInstance instance, const char *name, PFN_xrVoidFunction *out)
{
	static const struct {
		const char *name;
		PFN_xrVoidFunction function;
	} all[] = {
		{"xrCreateReferenceSpace", (PFN_xrVoidFunction)make_space},
		{"xrDestroySpace", (PFN_xrVoidFunction)end_space},
		{"xrDestroySession", (PFN_xrVoidFunction)end_session},
		{"xrDestroyInstance", (PFN_xrVoidFunction)end_instance},
		{"xrLocateSpace", (PFN_xrVoidFunction)place},
		{"xrGetSystemProperties", (PFN_xrVoidFunction)properties},
		{TIME_FUNCTION, (PFN_xrVoidFunction)to_timespec},
	};
	(void)instance;
	for (size_t i = 0; i < sizeof all / sizeof *all; i++)
		if (!strcmp(name, all[i].name))
			return *out = all[i].function, XR_SUCCESS;
	return XR_ERROR_FUNCTION_UNSUPPORTED;
}

static XRAPI_ATTR XrResult XRAPI_CALL make_instance(const XrInstanceCreateInfo *info, const XrApiLayerCreateInfo *create, XrInstance *out)
{
	(void)create;
	for (uint32_t i = 0; i < info->enabledExtensionCount; i++)
		if (strcmp(info->enabledExtensionNames[i], TIME_EXTENSION))
			return XR_ERROR_EXTENSION_NOT_PRESENT;
	*out = (XrInstance)1;
	return XR_SUCCESS;
}

/* ---- a bridge ---- */

static RhotHands *memory;
static _Atomic int ended;

static void store(void *words, const void *from, size_t size)
{
	_Atomic uint32_t *to = words;
	const uint32_t *word = from;
	for (size_t i = 0; i < size / sizeof *word; i++)
		atomic_store_explicit(&to[i], word[i], memory_order_relaxed);
}

static void *write_hands(void *nothing)
{
	unsigned seed = 1;
	uint32_t sequence = 0;
	RhotHand hand = {0};
	for (long number = 1; !atomic_load(&ended); number++) {
		float value = 0.001f * (float)(number % 1000);
		for (int i = 0; i < JOINTS; i++)
			hand.joints[i] = (RhotJoint){{value, value, value}, {0, 0, 0, 1}, 0.1f * value, {0, 0, 0}, {0, 0, 0}};
		hand.state = RHOT_HAND_MEASURED;
		hand.t_ns = now_ns();
		_Atomic uint32_t *words = (_Atomic uint32_t *)(void *)&memory->hands[1];
		atomic_store_explicit(&words[0], sequence | 1, memory_order_relaxed);
		atomic_thread_fence(memory_order_release);
		size_t half = rand_r(&seed) % 256 == 0 ? sizeof hand / 2 : sizeof hand;
		store(&words[1], (const uint32_t *)(const void *)&hand + 1, half - sizeof(uint32_t));
		if (half < sizeof hand) {
			usleep(rand_r(&seed) % 2000); /* dead, and followed by another */
			store(&words[1], (const uint32_t *)(const void *)&hand + 1, sizeof hand - sizeof(uint32_t));
		}
		atomic_store_explicit(&words[0], sequence += 2, memory_order_release);
		usleep(50);
	}
	return nothing;
}

/* ---- programs ---- */

static PFN_xrLocateHandJointsEXT locate;
static XrHandTrackerEXT right;
static XrSpace base;
static long calls;
static _Atomic long tracked, torn;

static int by_size(const void *a, const void *b) { return (*(const float *)a > *(const float *)b) - (*(const float *)a < *(const float *)b); }

static void *read_hands(void *took)
{
	XrHandJointLocationEXT joints[JOINTS];
	XrHandJointVelocityEXT moving[JOINTS];
	XrHandJointVelocitiesEXT velocities = {XR_TYPE_HAND_JOINT_VELOCITIES_EXT, NULL, JOINTS, moving};
	XrHandJointLocationsEXT out = {XR_TYPE_HAND_JOINT_LOCATIONS_EXT, &velocities, 0, JOINTS, joints};
	for (long i = 0; i < calls; i++) {
		int64_t begun = now_ns();
		XrHandJointsLocateInfoEXT info = {XR_TYPE_HAND_JOINTS_LOCATE_INFO_EXT, NULL, base, begun};
		if (locate(right, &info, &out) != XR_SUCCESS)
			abort();
		((float *)took)[i] = 1e-3f * (float)(now_ns() - begun);
		tracked += out.isActive;
		float first = joints[0].pose.position.x;
		for (int j = 0; out.isActive && j < JOINTS; j++)
			torn += joints[j].pose.position.x != first || joints[j].pose.position.z != first;
	}
	return NULL;
}

int main(int count, char **arguments)
{
	calls = count > 1 ? atol(arguments[1]) : 1000;
	char path[] = "/tmp/hammer_hands_XXXXXX";
	int file = mkstemp(path);
	if (file < 0 || ftruncate(file, sizeof *memory) || setenv("RHOT_HANDS", path, 1))
		return 1;
	memory = mmap(NULL, sizeof *memory, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
	memory->magic = RHOT_HANDS_MAGIC;
	memory->version = RHOT_HANDS_VERSION;

	XrNegotiateLoaderInfo loader = {XR_LOADER_INTERFACE_STRUCT_LOADER_INFO, 1, sizeof loader, 1, 1, XR_MAKE_VERSION(1, 0, 0), XR_MAKE_VERSION(1, 1023, 4095)};
	XrNegotiateApiLayerRequest request = {XR_LOADER_INTERFACE_STRUCT_API_LAYER_REQUEST, 1, sizeof request, 0, 0, NULL, NULL};
	if (xrNegotiateLoaderApiLayerInterface(&loader, LAYER_NAME, &request))
		return 2;
	XrApiLayerNextInfo next = {XR_LOADER_INTERFACE_STRUCT_API_LAYER_NEXT_INFO, 1, sizeof next, LAYER_NAME, runtime_proc, make_instance, NULL};
	XrApiLayerCreateInfo create = {XR_LOADER_INTERFACE_STRUCT_API_LAYER_CREATE_INFO, 1, sizeof create, NULL, "", &next};
	XrInstanceCreateInfo info = {.type = XR_TYPE_INSTANCE_CREATE_INFO, .enabledExtensionCount = EXTENSIONS, .enabledExtensionNames = EXTENSION};
	XrInstance instance;
	if (request.createApiLayerInstance(&info, &create, &instance))
		return 3;
	PFN_xrCreateHandTrackerEXT make_tracker;
	PFN_xrCreateReferenceSpace make_stage;
	PFN_xrDestroyInstance end;
	request.getInstanceProcAddr(instance, "xrCreateHandTrackerEXT", (PFN_xrVoidFunction *)&make_tracker);
	request.getInstanceProcAddr(instance, "xrLocateHandJointsEXT", (PFN_xrVoidFunction *)&locate);
	request.getInstanceProcAddr(instance, "xrCreateReferenceSpace", (PFN_xrVoidFunction *)&make_stage);
	request.getInstanceProcAddr(instance, "xrDestroyInstance", (PFN_xrVoidFunction *)&end);
	XrReferenceSpaceCreateInfo stage = {XR_TYPE_REFERENCE_SPACE_CREATE_INFO, NULL, XR_REFERENCE_SPACE_TYPE_STAGE, {{0, 0, 0, 1}, {0, 0, 0}}};
	XrHandTrackerCreateInfoEXT which = {XR_TYPE_HAND_TRACKER_CREATE_INFO_EXT, NULL, XR_HAND_RIGHT_EXT, XR_HAND_JOINT_SET_DEFAULT_EXT};
	if (make_stage((XrSession)1, &stage, &base) || make_tracker((XrSession)1, &which, &right))
		return 4;

	float *took = calloc((size_t)calls * 2, sizeof *took);
	pthread_t writer, readers[2];
	pthread_create(&writer, NULL, write_hands, NULL);
	for (int i = 0; i < 2; i++)
		pthread_create(&readers[i], NULL, read_hands, took + i * calls);
	usleep(1000); /* the threads' own memory */
	long before = allocations;
	for (int i = 0; i < 2; i++)
		pthread_join(readers[i], NULL);
	long made = allocations - before;
	ended = 1;
	pthread_join(writer, NULL);
	qsort(took, (size_t)calls * 2, sizeof *took, by_size);
	printf("calls %ld tracked %ld torn %ld allocations %ld median_us %.3f p99_us %.3f\n", 2 * calls, tracked, torn, made,
	       (double)took[calls], (double)took[calls * 198 / 100]);
	free(took);
	unlink(path);
	return end(instance);
}
