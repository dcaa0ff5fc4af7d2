/* Walks from face to face of meshes of triangles and quads: which half-edges are twins, what is connected, which way
 * round faces go, which corners lie round one vertex, and where grid lines and fans of triangles run.
 *
 * What walks further than a range of faces can be interrupted: all it knows lies in arrays of the caller, and a call
 * takes so many steps. Each walk marks or counts what it visits, so that it ends whatever the twins are.
 */
#include "mesh.h"

/* Twins ----------------------------------------------------------------------------------------------------------- */

/* The lower and the higher vertex of an edge; false where either is none. */
static inline bool ends_of(const int32_t *corners, int64_t half, int64_t vertices, int32_t *low, int32_t *high) {
    int32_t a = corners[half], b = corners[next_half_edge(corners, half)];
    *low = a < b ? a : b;
    *high = a < b ? b : a;
    return *low >= 0 && *high < vertices;
}

int64_t lode_mesh_count_edges(const int32_t *corners, int64_t corners_count, int32_t *start, int64_t start_count) {
    int32_t low, high;
    if (!is_faces(corners_count))
        return LODE_REFUSED;
    for (int64_t half = 0; half < corners_count; half++) {
        if ((half & 3) == 3 && is_triangle(corners, half))
            continue;
        if (!ends_of(corners, half, start_count - 1, &low, &high) || start[low + 1] == INT32_MAX)
            return LODE_REFUSED;
        start[low + 1]++;
    }
    return 0;
}

int64_t lode_mesh_sort_edges(const int32_t *corners, int64_t corners_count, int64_t first, int64_t last, int32_t *start,
                             int64_t start_count, int32_t *order, int64_t order_count) {
    int32_t low, high;
    if (!is_faces(corners_count) || first < 0 || first > last || last > corners_count / 4 ||
        order_count > corners_count)
        return LODE_REFUSED;
    for (int64_t half = 4 * first; half < 4 * last; half++) {
        if ((half & 3) == 3 && is_triangle(corners, half))
            continue;
        if (!ends_of(corners, half, start_count, &low, &high) || !within(start[low], order_count))
            return LODE_REFUSED;
        order[start[low]++] = (int32_t)half;
    }
    return 0;
}

int64_t lode_mesh_match_edges(const int32_t *corners, int64_t corners_count, const int32_t *order, int64_t order_count,
                              int32_t *met, int64_t met_count, int32_t *twins, int64_t twins_count, int64_t *crossed,
                              int64_t crossed_count) {
    int32_t low, high;
    int64_t same = 0;
    if (!is_mesh(corners_count, twins_count) || crossed_count != 1)
        return LODE_REFUSED;
    for (int64_t j = 0; j < order_count; j++) {
        int32_t half = order[j];
        if (!is_half_edge(corners, corners_count, half) || !ends_of(corners, half, met_count / 2, &low, &high))
            return LODE_REFUSED;
        int32_t *last = &met[2 * (int64_t)high];
        int32_t other = last[1];
        if (last[0] != low) {
            last[0] = low;
            last[1] = half;
        } else if (other >= 0) {
            if (other >= corners_count)
                return LODE_REFUSED;
            twins[half] = other;
            twins[other] = half;
            same += corners[other] == corners[half];
            last[1] = -1;
        } else if (half < crossed[0]) {
            crossed[0] = half;
        }
    }
    return same;
}

int64_t lode_mesh_tear(const int32_t *attributes, int64_t attributes_count, int64_t first, int64_t last, int32_t *twins,
                       int64_t twins_count, int64_t *torn, int64_t torn_count) {
    if (!is_faces(twins_count) || first < 0 || first > last || last > twins_count / 4 ||
        (torn_count && attributes_count / torn_count != twins_count) || attributes_count != torn_count * twins_count)
        return LODE_REFUSED;
    for (int64_t a = 0; a < torn_count; a++)
        torn[a] = 0;
    for (int64_t half = 4 * first; half < 4 * last; half++) {
        int64_t twin = twins[half];
        if (twin < half)
            continue;
        if (twin >= twins_count)
            return LODE_REFUSED;
        /* Both are of quads. Each runs from where the other ends. */
        int64_t end = (half & ~INT64_C(3)) | ((half + 1) & 3), twin_end = (twin & ~INT64_C(3)) | ((twin + 1) & 3);
        bool differs = false;
        for (int64_t a = 0; a < torn_count; a++) {
            const int32_t *rows = attributes + a * twins_count;
            if (rows[half] != rows[twin_end] || rows[end] != rows[twin]) {
                torn[a]++;
                differs = true;
            }
        }
        if (differs)
            twins[half] = twins[twin] = -1;
    }
    return 0;
}

int64_t lode_mesh_rows(const int32_t *corners, int64_t corners_count, const int32_t *rows, int64_t rows_count,
                       int32_t *row_of, int64_t row_of_count) {
    if (rows_count != corners_count)
        return LODE_REFUSED;
    for (int64_t corner = 0; corner < corners_count; corner++) {
        int64_t vertex = corners[corner];
        if (vertex < 0)
            continue;
        if (vertex >= row_of_count)
            return LODE_REFUSED;
        int32_t known = row_of[vertex];
        if (known < 0)
            row_of[vertex] = rows[corner];
        else if (known != rows[corner])
            return 0;
    }
    return 1;
}

/* Pieces ---------------------------------------------------------------------------------------------------------- */

int64_t lode_mesh_pieces(const int32_t *twins, int64_t twins_count, int32_t *piece, int64_t piece_count, int32_t *queue,
                         int64_t queue_count, int64_t *state, int64_t state_count, int64_t steps) {
    if (!is_faces(twins_count) || piece_count != twins_count / 4 || queue_count != piece_count || state_count != 4)
        return LODE_REFUSED;
    int64_t seed = state[0], place = state[1], end = state[2], count = state[3];
    if (seed < 0 || place < 0 || end < place || end > piece_count || !within(count, piece_count + 1) ||
        (place < end && !count))
        return LODE_REFUSED;
    for (; steps > 0; steps--) {
        if (place == end) {
            while (seed < piece_count && piece[seed] >= 0)
                seed++;
            if (seed >= piece_count)
                break;
            if (end == queue_count)
                return LODE_REFUSED;
            piece[seed] = (int32_t)count++;
            queue[end++] = (int32_t)seed;
        }
        int64_t face = queue[place++];
        if (!within(face, piece_count))
            return LODE_REFUSED;
        for (int64_t half = 4 * face; half < 4 * face + 4; half++) {
            int32_t twin = twins[half], other = twin >> 2;
            if (twin < 0)
                continue;
            if (other >= piece_count)
                return LODE_REFUSED;
            if (piece[other] >= 0)
                continue;
            if (end == queue_count)
                return LODE_REFUSED;
            piece[other] = (int32_t)(count - 1);
            queue[end++] = other;
            fetch(&twins[4 * (int64_t)other]);
        }
    }
    state[0] = seed;
    state[1] = place;
    state[2] = end;
    state[3] = count;
    return steps > 0;
}

/* Put the faces beside one into the queue, turned round if that one is, or else if the half-edges between both run the
 * same way. 1 if that fits to those that were seen before, 0 if not, -1 where there are no such faces. */
static inline int turn_beside(const int32_t *corners, const int32_t *twins, int64_t face, int64_t faces,
                              uint8_t *turned, int32_t *queue, int64_t *end) {
    for (int64_t half = 4 * face; half < 4 * face + 4; half++) {
        int32_t twin = twins[half], other = twin >> 2;
        if (twin < 0)
            continue;
        if (other >= faces)
            return -1;
        uint8_t side = turned[face] ^ (corners[half] == corners[twin]);
        if (turned[other] > 1) {
            if (*end == faces)
                return -1;
            turned[other] = side;
            queue[(*end)++] = other;
            fetch(&twins[4 * (int64_t)other]);
            fetch(&corners[4 * (int64_t)other]);
        } else if (turned[other] != side) {
            return 0;
        }
    }
    return 1;
}

int64_t lode_mesh_orient(const int32_t *corners, int64_t corners_count, const int32_t *twins, int64_t twins_count,
                         uint8_t *turned, int64_t turned_count, int32_t *queue, int64_t queue_count, int64_t *state,
                         int64_t state_count, int64_t steps) {
    int64_t faces = turned_count;
    if (!is_mesh(corners_count, twins_count) || faces != twins_count / 4 || queue_count != faces || state_count != 5)
        return LODE_REFUSED;
    int64_t seed = state[0], begin = state[1], place = state[2], end = state[3], balance = state[4];
    if (seed < 0 || begin < 0 || place < begin || end < place || end > faces || balance < -faces || balance > faces)
        return LODE_REFUSED;
    for (; steps > 0; steps--) {
        if (place < end) {
            int64_t face = queue[place++];
            if (!within(face, faces) || turned[face] > 1)
                return LODE_REFUSED;
            balance += turned[face] ? -1 : 1;
            int fits = turn_beside(corners, twins, face, faces, turned, queue, &end);
            if (fits < 0)
                return LODE_REFUSED;
            if (!fits)
                return 2 + face;
        } else if (begin < end && balance < 0) { /* of this piece more were turned than not: the other way round */
            int64_t face = queue[begin++];
            if (!within(face, faces))
                return LODE_REFUSED;
            turned[face] ^= 1;
        } else {
            while (seed < faces && turned[seed] <= 1)
                seed++;
            if (seed >= faces)
                break;
            if (end == faces)
                return LODE_REFUSED;
            begin = place = end;
            balance = 0;
            turned[seed] = 0;
            queue[end++] = (int32_t)seed;
        }
    }
    state[0] = seed;
    state[1] = begin;
    state[2] = place;
    state[3] = end;
    state[4] = balance;
    return steps > 0;
}

/* Umbrellas ------------------------------------------------------------------------------------------------------- */

int64_t lode_mesh_umbrellas(const int32_t *corners, int64_t corners_count, const int32_t *twins, int64_t twins_count,
                            int32_t *umbrella, int64_t umbrella_count, int32_t *valence, int64_t valence_count,
                            int64_t *state, int64_t state_count, int64_t steps) {
    const int64_t ahead = 16; /* corners further on that are soon begun with */
    if (!is_mesh(corners_count, twins_count) || umbrella_count != twins_count || state_count != 6)
        return LODE_REFUSED;
    int64_t seed = state[0], count = state[1], half = state[2], faces = state[3], back = state[4], total = state[5];
    if (seed < 0 || count < 0 || faces < 0 || total < faces || (faces && seed >= twins_count))
        return LODE_REFUSED;
    for (; steps > 0; steps--) {
        if (faces == 0) {
            while (seed < twins_count && (umbrella[seed] >= 0 || corners[seed] < 0))
                seed++;
            if (seed >= twins_count)
                break;
            half = seed;
            back = 0;
            int64_t beside = seed + ahead < twins_count ? twins[seed + ahead] : -1;
            if (within(beside, twins_count)) {
                fetch(&corners[beside]);
                fetch(&twins[beside]);
            }
        }
        if (!within(half, twins_count) || total >= twins_count || count >= valence_count)
            return LODE_REFUSED;
        /* From the seed to the faces before it, round to the seed or to a border; from there the other way. */
        if (back)
            half = next_half_edge(corners, half);
        umbrella[half] = (int32_t)count;
        half = back ? twins[half] : twin_before(corners, twins, half);
        if (half < 0 && !back) {
            half = twins[seed];
            back = 1;
        }
        faces++;
        total++;
        if (half < 0 || half == seed) {
            valence[count++] = (int32_t)(back ? -faces : faces);
            faces = 0;
        }
    }
    state[0] = seed;
    state[1] = count;
    state[2] = half;
    state[3] = faces;
    state[4] = back;
    state[5] = total;
    return steps > 0;
}

int64_t lode_mesh_trace(const struct lode_mesh_trace *arguments) {
    const struct lode_mesh_trace call = *arguments;
    int64_t steps = call.steps;
    if (!is_mesh(call.corners_count, call.twins_count) || call.umbrella_count != call.twins_count ||
        call.passed_count != call.valence_count || call.cut_count != call.twins_count || call.state_count != 3)
        return LODE_REFUSED;
    int64_t place = call.state[0], kept = call.state[1], count = call.state[2];
    if (kept < 0 || place < kept || count < place || call.riders_count < count)
        return LODE_REFUSED;
    for (; steps > 0; steps--) {
        if (place == count) {
            if (kept == 0)
                break;
            count = kept;
            place = kept = 0;
        }
        int64_t half = call.riders[place++];
        if (!within(half, call.twins_count) || !within(call.twins[half], call.twins_count))
            return LODE_REFUSED;
        if (call.cut[half])
            continue;
        call.cut[half] = call.cut[call.twins[half]] = 1;
        int64_t ahead = next_half_edge(call.corners, half), vertex = call.umbrella[ahead];
        if (!within(vertex, call.valence_count))
            return LODE_REFUSED;
        if (call.valence[vertex] != 4 || (call.passed[vertex] && !call.whole))
            continue;
        call.passed[vertex] = 1;
        if (!within(call.twins[ahead], call.twins_count))
            return LODE_REFUSED;
        call.riders[kept++] = (int32_t)next_half_edge(call.corners, call.twins[ahead]);
    }
    call.state[0] = place;
    call.state[1] = kept;
    call.state[2] = count;
    return steps > 0;
}

/* Poles ----------------------------------------------------------------------------------------------------------- */

enum { FEWEST_ROUND = 3 /* fewer triangles round an inner vertex would share two edges each */ };

/* What is known on the way round a fan of triangles. */
struct fan {
    const int32_t *corners, *umbrella, *valence;
    int64_t vertices;
    const uint8_t *pole;
    int32_t *missing;
    bool together;
};

/* Whether a triangle of the fan round a vertex lets it be a pole: 1, or 0 if not, -1 where there is no such triangle.
 * Its half-edge `half` leaves the vertex; `first` and `last` are at the ends of an open fan. */
static inline int look_at_triangle(const struct fan *fan, int64_t half, bool first, bool last) {
    int64_t right = fan->umbrella[next_half_edge(fan->corners, half)];
    int64_t left = fan->umbrella[previous_half_edge(fan->corners, half)];
    if (!within(right, fan->vertices) || !within(left, fan->vertices))
        return -1;
    if (fan->together && (fan->pole[right] || (last && fan->pole[left])))
        return 0;
    return first || (fan->valence[right] > 0 ? fan->missing[right] > 0 : fan->valence[right] == -2);
}

/* The vertex is a pole, so that one triangle less is missing where two triangles of its fan meet. */
static inline int take_triangle(const struct fan *fan, int64_t half) {
    int64_t right = fan->umbrella[next_half_edge(fan->corners, half)];
    if (!within(right, fan->vertices))
        return -1;
    if (fan->valence[right] > 0 && fan->missing[right] > INT32_MIN)
        fan->missing[right]--;
    return 1;
}

int64_t lode_mesh_poles(const struct lode_mesh_poles *arguments) {
    const struct lode_mesh_poles call = *arguments;
    int64_t steps = call.steps;
    struct fan fan = {call.corners, call.umbrella, call.valence, call.valence_count,
                      call.pole,    call.missing,  call.together};
    if (!is_mesh(call.corners_count, call.twins_count) || call.umbrella_count != call.twins_count ||
        call.leaving_count != call.valence_count || call.pole_count != call.valence_count ||
        call.missing_count != call.valence_count || call.state_count != 4)
        return LODE_REFUSED;
    /* Round each fan once to see whether all fits, and once more to take it. */
    int64_t place = call.state[0], turn = call.state[1], half = call.state[2], taking = call.state[3];
    if (place < 0 || turn < 0)
        return LODE_REFUSED;
    for (; steps > 0 && place < call.order_count; steps--) {
        int64_t vertex = call.order[place];
        if (!within(vertex, call.valence_count))
            return LODE_REFUSED;
        bool open = call.valence[vertex] < 0;
        int64_t faces = open ? -(int64_t)call.valence[vertex] : call.valence[vertex];
        if (faces < (open ? 2 : FEWEST_ROUND)) {
            place++;
            continue;
        }
        if (turn == 0)
            half = call.leaving[vertex];
        if (!is_half_edge(call.corners, call.twins_count, half) || turn >= faces || faces > call.twins_count)
            return LODE_REFUSED;
        bool first = open && turn == 0, last = open && turn == faces - 1;
        int fits = taking ? take_triangle(&fan, half) : look_at_triangle(&fan, half, first, last);
        if (fits < 0)
            return LODE_REFUSED;
        half = twin_before(call.corners, call.twins, half);
        turn++;
        if (fits && turn < faces)
            continue;
        if (fits && !taking)
            call.pole[vertex] = 1;
        taking = fits && !taking && call.together;
        if (taking)
            call.missing[vertex] = 0;
        else
            place++;
        turn = 0;
    }
    call.state[0] = place;
    call.state[1] = turn;
    call.state[2] = half;
    call.state[3] = taking;
    return place >= call.order_count;
}

/* What the corners of a quad have beside their vertices, which was a triangle with its tip at a pole. */
static inline void unfold_row(const int32_t *row, const int32_t *beside, int64_t tip, int64_t tip_beside, bool folded,
                              int32_t *unfolded) {
    unfolded[0] = row[tip];
    unfolded[1] = row[(tip + 1) % 3];
    unfolded[2] = row[(tip + 2) % 3];
    unfolded[3] = folded ? row[3] : row[tip];
    if (!folded && beside && beside[(tip_beside + 1) % 3] == unfolded[2])
        unfolded[3] = beside[tip_beside];
}

int64_t lode_mesh_unfold(const struct lode_mesh_unfold *arguments) {
    const struct lode_mesh_unfold call = *arguments;
    int64_t steps = call.steps;
    if (!is_mesh(call.corners_count, call.twins_count) || call.folded_count != call.twins_count / 4 ||
        call.new_corners_count != call.corners_count || call.new_attributes_count != call.attributes_count ||
        (call.attributes_count && !call.corners_count) ||
        (call.corners_count && call.attributes_count % call.corners_count) || call.vertices < 0 ||
        call.pole_of_count > INT32_MAX || call.vertices > INT32_MAX - call.pole_of_count || call.state_count != 4)
        return LODE_REFUSED;
    int64_t place = call.state[0], half = call.state[1], first_new = call.state[2], count = call.state[3];
    if (place < 0 || first_new < 0 || count < first_new || count > call.pole_of_count)
        return LODE_REFUSED;
    for (; steps > 0 && place < call.starts_count; steps--) {
        int64_t start = call.starts[place];
        if (count == first_new)
            half = start;
        if (!within(start, call.twins_count) || !is_half_edge(call.corners, call.twins_count, half) ||
            !is_triangle(call.corners, half) || count == call.pole_of_count)
            return LODE_REFUSED;
        int64_t face = half >> 2, tip = half & 3, following = twin_before(call.corners, call.twins, half);
        bool closed = call.twins[start] >= 0, last = following < 0 || following == start;
        if (following >= call.twins_count || (following < 0 && closed) || (following >= 0 && (following & 3) == 3))
            return LODE_REFUSED;
        const int32_t *old = call.corners + 4 * face;
        int32_t *quad = call.new_corners + 4 * face;
        quad[0] = (int32_t)(call.vertices + count);
        quad[1] = old[(tip + 1) % 3];
        quad[2] = old[(tip + 2) % 3];
        quad[3] = (int32_t)(call.vertices + (last && closed ? first_new : count + 1));
        for (int64_t row = 4 * face; row < call.attributes_count; row += call.corners_count) {
            const int32_t *beside = following < 0 ? 0 : call.attributes + row - 4 * face + (following & ~INT64_C(3));
            unfold_row(call.attributes + row, beside, tip, following & 3, call.folded[face], call.new_attributes + row);
        }
        call.pole_of[count++] = old[tip];
        half = following;
        if (!last)
            continue;
        if (!closed) {
            if (count == call.pole_of_count)
                return LODE_REFUSED;
            call.pole_of[count++] = old[tip];
        }
        first_new = count;
        place++;
    }
    call.state[0] = place;
    call.state[1] = half;
    call.state[2] = first_new;
    call.state[3] = count;
    return place >= call.starts_count;
}
