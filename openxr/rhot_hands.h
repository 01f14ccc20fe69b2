/* The hands that RHOT tracks, as `rhot bridge openxr` keeps them in shared memory for any program on this machine.
 *
 * Linux: the file /dev/shm/rhot_hands.UID (UID: the user's number), readable by that user alone; the environment
 * variable RHOT_HANDS names another file. Windows: the named file mapping "Local\rhot_hands".
 *
 * Everything is little-endian, in metres, seconds and radians, in OpenXR's STAGE space: x right, y up, z backwards, the
 * origin on the floor. Joints are the 26 of XR_EXT_hand_tracking in its order, with its axes.
 *
 * Each hand has a sequence lock. The writer makes `sequence` odd, writes the hand, and makes it even again. A reader
 * takes `sequence`, copies the hand, and takes `sequence` again: if it was odd or has changed, the copy is torn, and the
 * reader tries again. A reader never waits: a writer that died while it wrote leaves an odd number behind, which is a
 * hand that is not tracked. The writer never makes the memory smaller, and keeps it when it ends.
 */
#ifndef RHOT_HANDS_H
#define RHOT_HANDS_H

#include <stdint.h>

#define RHOT_HANDS_MAGIC 0x444e4148u /* "HAND" */
#define RHOT_HANDS_VERSION 1u        /* another version has another layout */
#define RHOT_HANDS_JOINTS 26

/* State of a hand. */
#define RHOT_HAND_ABSENT 0u
#define RHOT_HAND_PREDICTED 1u /* hidden for a moment, carried on by the tracker's model */
#define RHOT_HAND_MEASURED 2u

typedef struct RhotJoint {
	float position[3];
	float orientation[4]; /* unit quaternion x, y, z, w */
	float radius;
	float linear_velocity[3];
	float angular_velocity[3]; /* about the axes of the stage */
} RhotJoint;

typedef struct RhotHand {
	uint32_t sequence;
	uint32_t state;
	int64_t t_ns; /* when the hand was there: CLOCK_MONOTONIC; on Windows QueryPerformanceCounter, in nanoseconds */
	RhotJoint joints[RHOT_HANDS_JOINTS];
} RhotHand;

typedef struct RhotHands {
	uint32_t magic;
	uint32_t version;
	RhotHand hands[2]; /* left, right */
} RhotHands;

#endif
