/* Faces of a mesh laid out in the plane, one beside the other, as cells of a lattice of squares or of triangles; and
 * grids of quads that were laid out.
 *
 * A direction of a lattice is a number: of squares 0 (0, 1), 1 (1, 0), 2 (0, -1), 3 (-1, 0); of triangles 0 (1, 0),
 * 1 (0, 1), 2 (-1, 1), and 3 to 5 their opposites. The heading of a face is the direction of its first half-edge; at
 * each corner it goes on by one direction, in triangles by two.
 */
#include "mesh.h"

static const int8_t SQUARE_STEPS[4][2] = {{0, 1}, {1, 0}, {0, -1}, {-1, 0}};
static const int8_t TRIANGLE_STEPS[6][2] = {{1, 0}, {0, 1}, {-1, 1}, {-1, 0}, {0, -1}, {1, -1}};

static inline uint64_t magnitude(int64_t value) {
    return value < 0 ? 0 - (uint64_t)value : (uint64_t)value;
}

/* Put a period into the basis (a, b), (0, d) of all that are sums of periods, 0 <= a, 0 <= b < d: Euclid's algorithm on
 * the first coordinates, then on the second ones. */
static void add_period(int64_t *period, int64_t x, int64_t y) {
    int64_t a = period[0], rest;
    uint64_t b = (uint64_t)period[1], v = (uint64_t)y, d = magnitude(period[2]), other;
    while (x != 0) {
        other = b - (uint64_t)(a / x) * v;
        rest = a % x;
        a = x;
        b = v;
        x = rest;
        v = other;
    }
    if (a < 0) {
        a = -a;
        b = 0 - b;
    }
    v = magnitude((int64_t)v);
    while (v != 0) {
        other = d % v;
        d = v;
        v = other;
    }
    if (d != 0) {
        other = magnitude((int64_t)b) % d;
        b = (int64_t)b < 0 && other ? d - other : other;
    }
    period[0] = a;
    period[1] = (int64_t)b;
    period[2] = (int64_t)d;
}

/* Faces laid out, see lode_mesh_develop. */
struct development {
    const int32_t *twins;
    int64_t faces;
    int32_t *piece, *first;
    int8_t *heading;
    uint8_t *turns;
    int64_t *periods;
    int32_t *stack;
    int64_t top;
};

/* A face whose first corner is at (x, y) if one goes there by a face of piece `number`. */
static inline bool place_face(struct development *laid, int64_t face, int64_t number, int64_t x, int64_t y,
                              int heading) {
    int32_t *first = laid->first + 2 * face;
    if (laid->heading[face] < 0) {
        if (laid->top == laid->faces)
            return false;
        laid->heading[face] = (int8_t)heading;
        laid->piece[face] = (int32_t)number;
        first[0] = (int32_t)x;
        first[1] = (int32_t)y;
        laid->stack[laid->top++] = (int32_t)face;
        fetch(&laid->twins[4 * face]);
    } else if (laid->heading[face] != heading) {
        laid->turns[number] = 1;
    } else if (first[0] != x || first[1] != y) {
        if (laid->periods[3 * number] < 0)
            return false;
        add_period(laid->periods + 3 * number, x - first[0], y - first[1]);
    }
    return true;
}

/* Place the faces beside one. False where there are none such, or no room for them. */
static inline __attribute__((always_inline)) bool place_beside(struct development *laid, int64_t face, int64_t number,
                                                               int sides, const int8_t (*steps)[2]) {
    const int directions = sides == 4 ? 4 : 6, turn = directions / sides;
    int64_t x = laid->first[2 * face], y = laid->first[2 * face + 1];
    int way = laid->heading[face];
    if (way < 0 || way >= directions)
        return false;
    for (int k = 0; k < sides; k++, way = (way + turn) % directions) {
        x += steps[way][0];
        y += steps[way][1];
        int32_t twin = laid->twins[4 * face + k];
        if (twin < 0)
            continue;
        /* The twin starts here, at corner m of the other face, and runs back. */
        int64_t other = twin >> 2, u = x, v = y;
        int m = twin & 3, back = (way + directions / 2 + (sides - m) * turn) % directions;
        if (other >= laid->faces || m >= sides)
            return false;
        for (int j = 0, along = back; j < m; j++, along = (along + turn) % directions) {
            u -= steps[along][0];
            v -= steps[along][1];
        }
        if (!place_face(laid, other, number, u, v, back))
            return false;
    }
    return true;
}

int64_t lode_mesh_develop(int64_t sides, const struct lode_mesh_develop *arguments) {
    const struct lode_mesh_develop call = *arguments;
    int64_t steps = call.steps;
    int64_t faces = call.heading_count;
    if ((sides != 3 && sides != 4) || !is_faces(call.twins_count) || faces != call.twins_count / 4 ||
        call.piece_count != faces || call.first_count != 2 * faces || call.stack_count != faces ||
        call.periods_count % 3 || call.periods_count / 3 != call.turns_count || call.state_count != 3)
        return LODE_REFUSED;
    struct development laid = {call.twins, faces,        call.piece, call.first,   call.heading,
                               call.turns, call.periods, call.stack, call.state[1]};
    int64_t seed = call.state[0], count = call.state[2];
    if (seed < 0 || !within(laid.top, faces + 1) || !within(count, call.turns_count + 1) || (laid.top && !count))
        return LODE_REFUSED;
    bool room = true;
    for (; steps > 0; steps--) {
        if (laid.top == 0) {
            while (seed < faces && call.heading[seed] >= 0)
                seed++;
            room = seed >= faces || count < call.turns_count;
            if (seed >= faces || !room)
                break;
            place_face(&laid, seed, count++, 0, 0, 0);
        }
        int64_t face = call.stack[--laid.top];
        if (!within(face, faces))
            return LODE_REFUSED;
        if (!(sides == 4 ? place_beside(&laid, face, count - 1, 4, SQUARE_STEPS)
                         : place_beside(&laid, face, count - 1, 3, TRIANGLE_STEPS)))
            return LODE_REFUSED;
    }
    call.state[0] = seed;
    call.state[1] = laid.top;
    call.state[2] = count;
    return steps > 0 && room ? 1 : room ? 0 : 2;
}

static inline double distance(const double *a, const double *b, int64_t axes) {
    double square = 0.0;
    for (int64_t axis = 0; axis < axes; axis++)
        square += (a[axis] - b[axis]) * (a[axis] - b[axis]);
    return __builtin_sqrt(square);
}

static inline void stretch(int64_t *low, int64_t *high, int64_t value) {
    if (value < *low)
        *low = value;
    if (value > *high)
        *high = value;
}

int64_t lode_mesh_survey(const struct lode_mesh_survey *arguments) {
    const struct lode_mesh_survey call = *arguments;
    int64_t faces = call.heading_count;
    if (!is_mesh(call.corners_count, call.twins_count) || faces != call.corners_count / 4 ||
        call.piece_count != faces || call.first_count != 2 * faces || call.low_count % 3 ||
        call.high_count != call.low_count || call.single_count != call.low_count || call.length_count != call.low_count)
        return LODE_REFUSED;
    for (int64_t face = 0; face < faces; face++) {
        int64_t x = call.first[2 * face], y = call.first[2 * face + 1], base = 3 * (int64_t)call.piece[face];
        int way = call.heading[face];
        if (way < 0 || way >= 6 || !within(base, call.low_count))
            return LODE_REFUSED;
        for (int k = 0; k < 3; k++, way = (way + 2) % 6) {
            int64_t family = base + way % 3, a = call.corners[4 * face + k], b = call.corners[4 * face + (k + 1) % 3];
            if (!within(a, call.points_rows) || !within(b, call.points_rows))
                return LODE_REFUSED;
            call.single[family] |= call.twins[4 * face + k] < 0;
            call.length[family] +=
                distance(call.points + a * call.points_pitch, call.points + b * call.points_pitch, call.points_columns);
            stretch(&call.low[base], &call.high[base], x);
            stretch(&call.low[base + 1], &call.high[base + 1], y);
            stretch(&call.low[base + 2], &call.high[base + 2], x + y);
            x += TRIANGLE_STEPS[way][0];
            y += TRIANGLE_STEPS[way][1];
        }
    }
    return 0;
}

/* The row and the column of a quad in the lattice: its first corner and those one step away in its two directions are
 * corners of it. */
static inline bool cell_of(const int32_t *first, const int8_t *heading, int64_t faces, int64_t face, int64_t *row,
                           int64_t *column) {
    if (!within(face, faces) || heading[face] < 0 || heading[face] > 3)
        return false;
    *row = first[2 * face] - (int64_t)(heading[face] >= 2);
    *column = first[2 * face + 1] - (int64_t)(heading[face] == 1 || heading[face] == 2);
    return true;
}

int64_t lode_mesh_bounds(const int64_t *faces, int64_t faces_count, const int32_t *first, int64_t first_count,
                         const int8_t *heading, int64_t heading_count, int64_t *bounds, int64_t bounds_count) {
    int64_t row, column;
    if (first_count != 2 * heading_count || bounds_count != 4)
        return LODE_REFUSED;
    for (int64_t j = 0; j < faces_count; j++) {
        if (!cell_of(first, heading, heading_count, faces[j], &row, &column))
            return LODE_REFUSED;
        stretch(&bounds[0], &bounds[1], row);
        stretch(&bounds[2], &bounds[3], column);
    }
    return 0;
}

static inline int64_t modulo(int64_t value, int64_t by) {
    int64_t rest = value % by;
    return rest < 0 ? rest + by : rest;
}

/* Put a corner at a node of a grid: 1, or 0 where another vertex is, -1 where the corner there is none. */
static inline int put_corner(int32_t *node, int32_t corner, const int32_t *identity, int64_t identity_count) {
    if (*node < 0) {
        *node = corner;
        return 1;
    }
    if (*node >= identity_count)
        return -1;
    return identity[*node] == identity[corner];
}

int64_t lode_mesh_fill(const struct lode_mesh_fill *arguments) {
    const struct lode_mesh_fill call = *arguments;
    const int64_t far = INT64_C(1) << 32;
    if (call.first_count != 2 * call.heading_count || !is_faces(call.identity_count) ||
        call.identity_count != 4 * call.heading_count || call.cells_height != call.height - !call.closed_rows ||
        call.cells_width != call.width - !call.closed_columns || call.top < -far || call.top > far ||
        call.left < -far || call.left > far)
        return LODE_REFUSED;
    for (int64_t j = 0; j < call.faces_count; j++) {
        int64_t face = call.faces[j], row, column;
        if (!cell_of(call.first, call.heading, call.heading_count, face, &row, &column))
            return LODE_REFUSED;
        row = call.closed_rows && call.height > 0 ? modulo(row - call.top, call.height) : row - call.top;
        column = call.closed_columns && call.width > 0 ? modulo(column - call.left, call.width) : column - call.left;
        if (!within(row, call.cells_height) || !within(column, call.cells_width))
            return LODE_REFUSED;
        if (call.cells[row * call.cells_pitch + column] >= 0)
            return j;
        call.cells[row * call.cells_pitch + column] = (int32_t)face;
        int64_t below = row + 1 == call.height ? 0 : row + 1, right = column + 1 == call.width ? 0 : column + 1;
        int32_t *around[4] = {&call.nodes[row * call.nodes_pitch + column], &call.nodes[row * call.nodes_pitch + right],
                              &call.nodes[below * call.nodes_pitch + right],
                              &call.nodes[below * call.nodes_pitch + column]};
        for (int k = 0; k < 4; k++) {
            int fits = put_corner(around[(call.heading[face] + k) & 3], (int32_t)(4 * face + k), call.identity,
                                  call.identity_count);
            if (fits < 0)
                return LODE_REFUSED;
            if (!fits)
                return j;
        }
    }
    return call.faces_count;
}
