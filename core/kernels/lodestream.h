/* The compiled kernels of Lodestream: all that core/lodestream/kernels.py declares and calls.
 *
 * An array is a pointer and, behind it, its number of elements. Arrays of arrays are in C order; `rows` of a plane that
 * need not lie side by side come as pointer, rows, columns, and `pitch`, the elements from one row to the next. The
 * caller owns all memory and has checked types; nothing here allocates, keeps anything between calls, or calls a
 * library. `reads` chooses between the two directions of a coder: 1 reads `data` and fills what it describes, 0 writes.
 *
 * What comes from a stream may hold anything: results are then wrong numbers, but no access leaves an array.
 * Where lengths and places that the caller gives do not fit each other, the answer is LODE_REFUSED and arrays that
 * would have been written are undefined.
 *
 * No call takes longer than about a tenth of a second, so that whoever waits can be interrupted: the caller divides
 * what is larger.
 */
#ifndef LODESTREAM_H
#define LODESTREAM_H

#include <stdint.h>

#define LODE_REFUSED INT64_MIN

#if defined(_WIN32)
#define LODE_API __declspec(dllexport)
#else
#define LODE_API __attribute__((visibility("default")))
#endif

/* The hash of the sources that the library was compiled from, 16 hexadecimal digits and a zero. */
LODE_API const char *lode_sources(void);

/* mask.c --------------------------------------------------------------------------------------------------------- */

/* Code rows `first` to `last` - 1 of a mask of `rows` x `columns` points.
 *
 * field:  flat, (rows + 2) x (columns + 6): two rows before and three columns at either side are zeros; 1 is valid.
 * model:  LODE_MASK_MODEL contexts and weights; begun where `first` is 0.
 * data:   writing, at least 64 + 2 rows columns bytes; reading, all there are, those missing count as zeros.
 * state:  four numbers that are handed on from call to call.
 * Returns the bytes written or looked at so far, all of them once `last` is `rows`.
 */
LODE_API int64_t lode_mask(int64_t reads, int64_t rows, int64_t columns, int64_t first, int64_t last, uint8_t *field,
                           int64_t field_count, int32_t *model, int64_t model_count, uint8_t *data, int64_t data_count,
                           int64_t *state, int64_t state_count);

#define LODE_MASK_MODEL ((1 << 16) + (1 << 10) + 4 + 2)

/* mesh.c --------------------------------------------------------------------------------------------------------- */

/* Faces are triangles and quads. In all that follows
 *
 * corners:  4 for each face, its vertices in the order round it, negative in the last place of a triangle. The faces'
 *           half-edges have the same numbers: 4 f + k runs from corner k of face f to the next one.
 * twins:    for each half-edge that of the face beside it, or negative where there is none.
 * umbrella: for each corner the number of its umbrella, a run of faces round a vertex, each beside the next; negative
 *           where there is no corner.
 * valence:  for each umbrella its faces, negative where it is open.
 * state:    what a walk hands on from call to call, zeros at first unless said otherwise. A call takes about `steps`
 *           steps, at least one.
 *
 * Walks return 1 when they are done, and 0 when they are to be called again, with the same arrays as they were left.
 * Numbers in the arrays that are no vertex, half-edge, umbrella or face are refused, as are twins that are not twins of
 * each other where a walk would not end for them.
 */

/* Count edges: adds to start[v + 1] the half-edges whose lower vertex is v. For any part of a mesh's faces.
 *
 * start: one more than vertices. */
LODE_API int64_t lode_mesh_count_edges(const int32_t *corners, int64_t corners_count, int32_t *start,
                                       int64_t start_count);

/* Sort the half-edges of faces `first` to `last` - 1 by their lower vertex.
 *
 * start: for each vertex the place in `order` of the next half-edge whose lower vertex it is.
 * order: filled from there with half-edges.
 */
LODE_API int64_t lode_mesh_sort_edges(const int32_t *corners, int64_t corners_count, int64_t first, int64_t last,
                                      int32_t *start, int64_t start_count, int32_t *order, int64_t order_count);

/* Find the twins among half-edges that are sorted by their lower vertex, for any run of them, one after another.
 *
 * met:     two for each vertex, -1 at first.
 * twins:   -1 at first; what they are where three half-edges meet is of no use.
 * crossed: one number: the lowest half-edge at an edge that already has two, if it is lower than what is there.
 * Returns the pairs that run the same way.
 */
LODE_API int64_t lode_mesh_match_edges(const int32_t *corners, int64_t corners_count, const int32_t *order,
                                       int64_t order_count, int32_t *met, int64_t met_count, int32_t *twins,
                                       int64_t twins_count, int64_t *crossed, int64_t crossed_count);

/* Part quads, `first` to `last` - 1 and those of higher numbers beside them, where attributes differ across the edge.
 *
 * attributes: for each attribute and each corner a number.
 * twins:      -1 from now on where any attribute differs.
 * torn:       one for each attribute, filled with the edges at which it differs.
 */
LODE_API int64_t lode_mesh_tear(const int32_t *attributes, int64_t attributes_count, int64_t first, int64_t last,
                                int32_t *twins, int64_t twins_count, int64_t *torn, int64_t torn_count);

/* Find the one row of values that all corners at each vertex have, for any part of a mesh's faces.
 *
 * rows:   one for each corner, not negative.
 * row_of: one for each vertex, -1 at first; filled with the row of the corners there.
 * Returns 1, or 0 where one was found that differs; `row_of` is of no use then.
 */
LODE_API int64_t lode_mesh_rows(const int32_t *corners, int64_t corners_count, const int32_t *rows, int64_t rows_count,
                                int32_t *row_of, int64_t row_of_count);

/* Number faces by the connected piece that they belong to, in the order of the pieces' first faces.
 *
 * piece: one for each face, -1 at first.
 * queue: as many.
 * state: four numbers, the last of which is that of pieces.
 */
LODE_API int64_t lode_mesh_pieces(const int32_t *twins, int64_t twins_count, int32_t *piece, int64_t piece_count,
                                  int32_t *queue, int64_t queue_count, int64_t *state, int64_t state_count,
                                  int64_t steps);

/* Find the faces to turn round so that all of a piece go round alike: the fewer of the two possible sets.
 *
 * turned: one for each face, 2 at first; filled with 0 and 1.
 * queue:  as many.
 * state:  five numbers.
 * Returns 2 + f where a surface with only one side was noticed at face f.
 */
LODE_API int64_t lode_mesh_orient(const int32_t *corners, int64_t corners_count, const int32_t *twins,
                                  int64_t twins_count, uint8_t *turned, int64_t turned_count, int32_t *queue,
                                  int64_t queue_count, int64_t *state, int64_t state_count, int64_t steps);

/* Number umbrellas, in the order of their lowest corners, of faces that go round alike.
 *
 * umbrella: -1 at first.
 * valence:  of any length; as many as corners suffice.
 * state:    six numbers, the second of which is that of umbrellas.
 */
LODE_API int64_t lode_mesh_umbrellas(const int32_t *corners, int64_t corners_count, const int32_t *twins,
                                     int64_t twins_count, int32_t *umbrella, int64_t umbrella_count, int32_t *valence,
                                     int64_t valence_count, int64_t *state, int64_t state_count, int64_t steps);

/* Trace grid lines over quads that go round alike, all one edge at a time in turn.
 *
 * whole:  1 where a line ends only at a border and at a vertex without four quads, 0 where also at other lines.
 * passed: one for each umbrella; 1 where a line begins, 0 elsewhere.
 * riders: the half-edges with which lines begin, each with a face on either side.
 * cut:    one for each half-edge, 0 at first; 1 along the lines.
 * state:  three numbers, at first 0, 0 and the lines.
 */
LODE_API int64_t lode_mesh_trace(const int32_t *corners, int64_t corners_count, const int32_t *twins,
                                 int64_t twins_count, const int32_t *umbrella, int64_t umbrella_count,
                                 const int32_t *valence, int64_t valence_count, int64_t whole, uint8_t *passed,
                                 int64_t passed_count, int32_t *riders, int64_t riders_count, uint8_t *cut,
                                 int64_t cut_count, int64_t *state, int64_t state_count, int64_t steps);

/* Find the poles of triangles that go round alike: vertices without which they are the halves of a grid's quads.
 *
 * leaving:  for each umbrella a half-edge that leaves it, with no face before it where the umbrella is open.
 * order:    umbrellas that may be poles.
 * together: 1 to take them one after another, each only if it fits to those before; 0 for each by itself.
 * pole:     one for each umbrella: 1 is a pole.
 * missing:  for each closed umbrella the triangles by which it is short of six; fewer once poles beside it are taken.
 * state:    four numbers.
 */
LODE_API int64_t lode_mesh_poles(const int32_t *corners, int64_t corners_count, const int32_t *twins,
                                 int64_t twins_count, const int32_t *umbrella, int64_t umbrella_count,
                                 const int32_t *valence, int64_t valence_count, const int32_t *leaving,
                                 int64_t leaving_count, const int32_t *order, int64_t order_count, int64_t together,
                                 uint8_t *pole, int64_t pole_count, int32_t *missing, int64_t missing_count,
                                 int64_t *state, int64_t state_count, int64_t steps);

/* Make each triangle of the fans round poles a quad whose side at the pole has two new vertices.
 *
 * starts:         a half-edge that leaves each pole, with no face before it where the fan is open.
 * folded:         one for each face; 1 where the quad's fourth corner has attributes of its own, those in the fourth
 *                 place of the triangle's.
 * attributes:     for each attribute and each corner a number.
 * vertices:       new ones are numbered from here.
 * new_corners:    as `corners`, but for the quads.
 * new_attributes: as `attributes`, but for the quads.
 * pole_of:        filled with the pole of each new vertex; as many as there are triangles in fans, and one more for
 *                 each open fan.
 * state:          four numbers, the last of which is that of new vertices.
 */
LODE_API int64_t lode_mesh_unfold(const int32_t *corners, int64_t corners_count, const int32_t *twins,
                                  int64_t twins_count, const int32_t *starts, int64_t starts_count,
                                  const uint8_t *folded, int64_t folded_count, const int32_t *attributes,
                                  int64_t attributes_count, int64_t vertices, int32_t *new_corners,
                                  int64_t new_corners_count, int32_t *new_attributes, int64_t new_attributes_count,
                                  int32_t *pole_of, int64_t pole_of_count, int64_t *state, int64_t state_count,
                                  int64_t steps);

/* mesh_lattice.c ------------------------------------------------------------------------------------------------- */

/* Lay out faces that all have so many `sides`, 3 or 4, and go round alike; arrays as above.
 *
 * piece:   one for each face, filled with its connected piece, in the order of the pieces' first faces.
 * first:   two for each face, filled with the place of its first corner.
 * heading: one for each face, -1 at first; filled with the direction of its first half-edge.
 * turns:   one for each piece, 0 at first; 1 where directions differ after a way round.
 * periods: three for each piece, 0 at first; filled with a, b, d: the ways by which one comes back to the same face are
 *          sums of (a, b) and (0, d), 0 <= a, 0 <= b < d. They wrap modulo 2^64.
 * stack:   one for each face.
 * state:   three numbers, the last of which is that of pieces.
 * Returns 2 when there are more pieces than `turns` and `periods` have room for: to be called again with larger ones.
 */
LODE_API int64_t lode_mesh_develop(int64_t sides, const int32_t *twins, int64_t twins_count, int32_t *piece,
                                   int64_t piece_count, int32_t *first, int64_t first_count, int8_t *heading,
                                   int64_t heading_count, uint8_t *turns, int64_t turns_count, int64_t *periods,
                                   int64_t periods_count, int32_t *stack, int64_t stack_count, int64_t *state,
                                   int64_t state_count, int64_t steps);

/* What there is along each of the three directions of triangles that were laid out, for any part of a mesh's faces.
 *
 * points: a row for each vertex.
 * low, high: three for each piece: the least and the largest x, y and x + y of a corner, if they are less or larger
 *            than what is there.
 * single:    three for each piece: 1 where a half-edge of direction 0, 1 or 2, or the opposite, has no twin.
 * length:    three for each piece: the lengths of all these half-edges are added.
 */
LODE_API int64_t lode_mesh_survey(const int32_t *corners, int64_t corners_count, const int32_t *twins,
                                  int64_t twins_count, const double *points, int64_t points_rows,
                                  int64_t points_columns, int64_t points_pitch, const int32_t *piece,
                                  int64_t piece_count, const int32_t *first, int64_t first_count, const int8_t *heading,
                                  int64_t heading_count, int64_t *low, int64_t low_count, int64_t *high,
                                  int64_t high_count, uint8_t *single, int64_t single_count, double *length,
                                  int64_t length_count);

/* The bounds of quads that were laid out, for any part of `faces`: the least and the largest row, the least and the
 * largest column of a quad, if they are less or larger than what `bounds` holds. */
LODE_API int64_t lode_mesh_bounds(const int64_t *faces, int64_t faces_count, const int32_t *first, int64_t first_count,
                                  const int8_t *heading, int64_t heading_count, int64_t *bounds, int64_t bounds_count);

/* Put quads that were laid out, and their corners, into their places in a grid.
 *
 * identity:  a number for each corner; at one node all are equal.
 * top, left: the row and the column of the first cell, at most 2^32 from 0. Where rows or columns are `closed`, others
 *            count modulo their number.
 * nodes:     a corner that lies there, or -1.
 * cells:     the face, or -1; as many rows and columns as nodes, but for one less where they are not closed.
 * Returns how many faces were put before one that lies on another or does not join it; all, where there is none.
 */
LODE_API int64_t lode_mesh_fill(const int64_t *faces, int64_t faces_count, const int32_t *first, int64_t first_count,
                                const int8_t *heading, int64_t heading_count, const int32_t *identity,
                                int64_t identity_count, int64_t top, int64_t left, int64_t closed_rows,
                                int64_t closed_columns, int32_t *nodes, int64_t height, int64_t width,
                                int64_t nodes_pitch, int32_t *cells, int64_t cells_height, int64_t cells_width,
                                int64_t cells_pitch);

#endif
