/* Half-edges of triangles and quads, for the kernels that walk over meshes.
 *
 * Faces are rows of four corners, the last of which is negative in a triangle. Half-edge 4 f + k runs from corner k of
 * face f to the next one. Its twin is the half-edge of the face on the other side of the edge, or negative where there
 * is none.
 *
 * Not part of the interface.
 */
#ifndef LODE_MESH_H
#define LODE_MESH_H

#include <stdbool.h>
#include <stdint.h>

#include "lodestream.h"

static inline bool within(int64_t place, int64_t count) {
    return place >= 0 && place < count;
}

/* Whether an array holds one number for each of four corners of faces that int32 can count. */
static inline bool is_faces(int64_t count) {
    return count >= 0 && count % 4 == 0 && count <= INT32_MAX;
}

static inline bool is_mesh(int64_t corners_count, int64_t twins_count) {
    return is_faces(corners_count) && twins_count == corners_count;
}

static inline bool is_triangle(const int32_t *corners, int64_t half) {
    return corners[half | 3] < 0;
}

/* Whether there is such a half-edge. */
static inline bool is_half_edge(const int32_t *corners, int64_t halves, int64_t half) {
    return within(half, halves) && corners[half] >= 0;
}

/* The next half-edge of the same face. */
static inline int64_t next_half_edge(const int32_t *corners, int64_t half) {
    int64_t k = half & 3;
    return k == 3 || (k == 2 && is_triangle(corners, half)) ? half - k : half + 1;
}

/* The half-edge before this one in the same face. */
static inline int64_t previous_half_edge(const int32_t *corners, int64_t half) {
    if (half & 3)
        return half - 1;
    return half + (is_triangle(corners, half) ? 2 : 3);
}

/* The twin of the half-edge before this one. In the first place it is that of one of two, both of which are read before
 * it is known which, as it takes long where faces lie far apart. */
static inline int32_t twin_before(const int32_t *corners, const int32_t *twins, int64_t half) {
    bool first = (half & 3) == 0;
    int32_t of_triangle = twins[first ? half + 2 : half - 1], of_quad = twins[first ? half + 3 : half - 1];
    return is_triangle(corners, half) ? of_triangle : of_quad;
}

/* Have what is soon read brought nearer. */
static inline void fetch(const int32_t *place) {
    __builtin_prefetch(place);
}

#endif
