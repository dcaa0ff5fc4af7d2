"""Rules of docs/format.md as the reference decoder has them, each changed by itself: what golden files must notice."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["MUTANTS", "Mutant"]


class Mutant(NamedTuple):
    """A change of one rule.

    `rule` (str): the section of docs/format.md, and what the mutant does otherwise; `file` (str): module of the
    reference; `old`, `new` (str): what stands there once, and what stands there instead; `first` (str): the golden file
    that is tried first, since it notices the mutant; `equivalent` (str): why no container can tell them apart, if that
    is so.
    """

    rule: str
    file: str
    old: str
    new: str
    first: str = ""
    equivalent: str = ""


MUTANTS = (
    # 1 and 2: fields and sections
    Mutant(
        "1: varints have groups of 7 bits, least significant first",
        "fields",
        "(byte & 127) << shift",
        "(byte & 127) << (shift and shift + 1)",
        "sections-optional",
    ),
    Mutant(
        "1: a float's bytes are its highest",
        "fields",
        '.ljust(8, b"\\0"))',
        '.rjust(8, b"\\0"))',
        "values-float64-most",
    ),
    Mutant(
        "1: an error's u32 is the upper half of a binary64",
        "fields",
        "self.take(4)[::-1] + bytes(4)",
        "self.take(4) + bytes(4)",
        "values-float32",
    ),
    Mutant(
        "1: a rough error's lowest bit is bit 47",
        "fields",
        '(self.number("H") << 47)',
        '(self.number("H") << 46)',
        "levels-blocks",
    ),
    Mutant(
        "2: optional sections may stand before the residual",
        "container",
        "if kind >= OPTIONAL:",
        "if kind >= OPTIONAL and (len(layers) < header.layers or not header.has_residual or residual):",
        "sections-optional",
    ),
    Mutant(
        "2: optional sections may stand before the first layer",
        "container",
        "if kind >= OPTIONAL:",
        "if kind >= OPTIONAL and layers:",
        "sections-optional",
    ),
    Mutant(
        "2: optional sections have the kinds 128 to 255",
        "container",
        "PAGES, OPTIONAL = 1, 2, 3, 4, 5, 6, 7, 8, 128",
        "PAGES, OPTIONAL = 1, 2, 3, 4, 5, 6, 7, 8, 129",
        "sections-optional",
    ),
    # 3: header
    Mutant(
        "3: bit 0 of the flags is that of the rows",
        "header",
        "closed, no = _pair(flags, 0), (False, False)",
        "closed, no = _pair(flags, 0)[::-1], (False, False)",
        "levels-one-by-one",
    ),
    Mutant(
        "3: the lower half of `tile` is of the rows",
        "header",
        "first, second = byte & 15, byte >> 4",
        "second, first = byte & 15, byte >> 4",
        "strings-odd",
    ),
    Mutant(
        "3: all channels of the points but the first three are attributes",
        "header",
        "return min(self.channels, 3)",
        "return self.channels",
        "patches-channels",
    ),
    Mutant(
        "3: rule 0 of lattices is affine, rule 1 decimal",
        "reconstruction",
        "if rule == 0 else (origin + wide) / step",
        "if rule == 0 else origin / step + wide / step",
        "values-decimal",
    ),
    Mutant(
        "3: values of integer types are rounded with ties to even",
        "reconstruction",
        "whole = np.rint(values)",
        "whole = np.floor(values + 0.5)",
        "levels-heights",
    ),
    Mutant(
        "3: values are clamped to the finite range of float32",
        "reconstruction",
        "clamped: NDArray[Any] = np.clip(values, -most, most).astype(dtype)",
        "clamped: NDArray[Any] = (np.clip(values, -most, most) if dtype.itemsize == 8 else values).astype(dtype)",
        "values-float32-most",
    ),
    Mutant(
        "3: values are clamped to the finite range of float64",
        "reconstruction",
        "clamped: NDArray[Any] = np.clip(values, -most, most).astype(dtype)",
        "clamped: NDArray[Any] = (np.clip(values, -most, most) if dtype.itemsize == 4 else values).astype(dtype)",
        "values-float64-most",
    ),
    Mutant(
        "3: values are rounded to the nearest float32",
        "reconstruction",
        "clamped: NDArray[Any] = np.clip(values, -most, most).astype(dtype)",
        (
            "clamped: NDArray[Any] = np.clip(values, -most, most).astype(dtype)\n"
            "        if dtype.itemsize == 4:\n"
            "            clamped = np.where(abs(clamped) > abs(values), np.nextafter(clamped, "
            "dtype.type(0)), clamped)"
        ),
        "values-float32",
    ),
    Mutant(
        "3: values are clamped to the range of integer types",
        "reconstruction",
        "whole, float(limits.min), np.next",
        "whole, float(limits.min) if limits.bits > 32 else -np.inf, np.next",
        "patches-attributes",
    ),
    Mutant(
        "3: the highest value of a type of 64 bits is reached",
        "reconstruction",
        "found[whole >= float(limits.max)] = limits.max",
        "pass",
        "values-int64",
    ),
    Mutant(
        "3: q in eighths is multiplied by 1/8",
        "reconstruction",
        "(0.125 if eighths else 1.0)",
        "(0.25 if eighths else 1.0)",
        "values-float32",
    ),
    # 3.1: patches and interfaces
    Mutant(
        "3.1: bit 1 of an interface is `stops`, bit 0 `closed`",
        "header",
        "Interface(value >> 2, bool(value & 2), bool(value & 1))",
        "Interface(value >> 2, bool(value & 1), bool(value & 2))",
        "tiles-stopped",
    ),
    Mutant(
        "3.1: with bit 2 a grid's rows are in reverse order",
        "reconstruction",
        "place = count - 1 - place if patch.reverse[axis] else place",
        "place = place",
        "cube-sphere-even",
    ),
    Mutant(
        "3.1: a window may pass the end of an axis that wraps",
        "reconstruction",
        "stands.append((first + place) % size)",
        "stands.append(np.minimum(first + place, size - 1))",
        "cylinder-flap",
    ),
    Mutant(
        "3.1: an interface that is `reversed` runs in the opposite order",
        "reconstruction",
        "line = points[::-1] if turned else points",
        "line = points",
        "tiles-stopped",
    ),
    Mutant(
        "3.1: open interfaces are clamped at both ends",
        "header",
        "(not c.closed, not c.closed)), Axis(1, False)",
        "(not c.closed, False)), Axis(1, False)",
        "patches-attributes",
    ),
    Mutant(
        "3.1: the first of common ends holds the point",
        "header",
        "same[max(met)] = min(met)",
        "same[min(met)] = max(met)",
        "patches-attributes",
    ),
    Mutant(
        "3.1: interfaces share an end at a corner of a patch",
        "header",
        "(along ^ turned) if interfaces",
        "(along ^ (not turned)) if interfaces",
        "patches-attributes",
    ),
    Mutant(
        "3.1: an interface of one point has that point as both ends",
        "header",
        "if interfaces[interface].length > 1 else 0",
        "",
        "error-blocks",
    ),
    Mutant(
        "3.1: also ends of the same interface copy",
        "header",
        "if len(met) == 2 and met[0] != met[1]:",
        "if len(met) == 2 and met[0][0] != met[1][0]:",
        "patches-loop",
    ),
    Mutant(
        "3.1: ends that are the same through others",
        "header",
        "return {end: first(end) for end in same}",
        "return {end: same[end] for end in same if same[end] not in same}",
        "patches-order",
    ),
    # 3.2: extras
    Mutant(
        "3.2: the first rule of a plane is that of x",
        "reconstruction",
        "zip(header.plane or [], (c, r), (block.columns, block.rows), strict=True)",
        "zip(header.plane or [], (r, c), (block.rows, block.columns), strict=True)",
        "plane-steps",
    ),
    Mutant(
        "3.2: an attribute of 0 components is an array (H, W)",
        "decoder",
        "np.stack(some, axis=-1) if attribute.components else some[0]",
        "np.stack(some, axis=-1)",
        "attributes-wide",
    ),
    # 3.3: masks
    Mutant(
        "3.3: integer points have the value `hole` at holes",
        "decoder",
        "[self.masks.hole, *[0]",
        "[0, *[0]",
        "sections-masks",
    ),
    Mutant(
        "3.3: integer attributes are 0 at holes",
        "decoder",
        "*[0] * len(header.attributes)]",
        "*[self.masks.hole + 1] * len(header.attributes)]",
        "sections-masks",
    ),
    Mutant(
        "3.3: kept holes have values with the residual alone",
        "decoder",
        "filled = valid if residual is None else valid | self.masks.kept[number]",
        "filled = valid",
        "infinite-error",
    ),
    # 4: levels
    Mutant(
        "4: an open axis takes a step from 3 samples on",
        "levels",
        "(5 if self.closed else 3)",
        "(5 if self.closed else 4)",
        "levels-blocks",
    ),
    Mutant(
        "4: a closed axis takes a step from 5 samples on",
        "levels",
        "(5 if self.closed else 3)",
        "(6 if self.closed else 3)",
        "curve",
    ),
    Mutant(
        "4: an axis that stops takes no step once its length is even",
        "levels",
        "and not (stops and self.samples % 2 == 0)",
        "",
        "tiles-stopped",
    ),
    Mutant(
        "4: the extra node of an open axis of even N",
        "levels",
        "return not self.closed and self.samples % 2 == 0",
        "return self.samples % 2 == 0",
        "levels-one-by-one",
    ),
    Mutant(
        "4: the last sample's node stands at that sample",
        "levels",
        "place[place == 2 * line.run] = line.samples - 1",
        "pass",
        "levels-blocks",
    ),
    Mutant(
        "4: steps are fitted from R = 24 on",
        "levels",
        "axes[level + 1][axis].run >= 24",
        "axes[level + 1][axis].run >= 25",
        "tiles-cut",
    ),
    Mutant(
        "4: a grid's own step with R < 24 has (16, 0)",
        "reconstruction",
        "if grid.axes[upper][axis].run < 24:",
        "if (upper - 1, 2 if grid.interface else axis) not in header.predictors[channel]:",
        "patches-predictors",
    ),
    Mutant(
        "4: interfaces have predictors of their own",
        "reconstruction",
        "[upper - 1, 2 if grid.interface else axis]",
        "[upper - 1, 0]",
        "strings-odd",
    ),
    Mutant(
        "4: a patch's bands leave out nodes of its last row that come from elsewhere",
        "levels",
        "return int(first), max(count - last, int(first))",
        "return int(first), count",
        "levels-blocks",
    ),
    Mutant(
        "4: an interface's bands leave out the ends that another end holds",
        "header",
        "((n, 0) in held, (n, 1) in held, False, False)",
        "((n, 0) in held, False, False, False)",
        "error-blocks",
    ),
    # 5: tiles
    Mutant(
        "5: bands come in the order (0, 1), (1, 0), (1, 1)",
        "tiles",
        "((0, 1), (1, 0), (1, 1)) if level",
        "((1, 0), (0, 1), (1, 1)) if level",
        "values-float32",
    ),
    Mutant(
        "5: a group has at most 2^(t0+t1+2) points",
        "tiles",
        "1 << (sum(tile) + 2)",
        "1 << (sum(tile) + 3)",
        "tiles-group",
    ),
    Mutant(
        "5: a group may have just 2^(t0+t1+2) points",
        "tiles",
        "for number in joined) <= points",
        "for number in joined) < points",
        "tiles-group",
    ),
    Mutant(
        "5: the points of a group are counted at level l",
        "tiles",
        "size = [int(np.prod(grid.shape(level), dtype=object)) for grid in grids]",
        "size = [int(np.prod(grid.shape(level - 1), dtype=object)) for grid in grids]",
        "tiles-group",
    ),
    Mutant(
        "5: interfaces join a group however many points they have",
        "tiles",
        "if grids[group[0]].interface or sum(",
        "if sum(",
        "tiles-interfaces",
    ),
    Mutant(
        "5: an interface is one tile, however long",
        "tiles",
        "if len(group) == 1 and not grids[group[0]].interface:",
        "if len(group) == 1:",
        "tiles-stopped",
    ),
    Mutant(
        "5: n = floor((h' + S/2 - 1) / S) runs",
        "tiles",
        "(nodes + size // 2 - 1) // size",
        "(nodes + size // 2) // size",
        "tiles-cut",
    ),
    Mutant(
        "5: the parent tile is (i >> s0, j >> s1): where axis 0 has stopped s0 is 0",
        "tiles",
        "min(i >> s[0], down - 1)",
        "min(i >> 1, down - 1)",
        "tiles-stopped-turned",
    ),
    Mutant(
        "5: the parent tile is (i >> s0, j >> s1): where axis 1 has stopped s1 is 0",
        "tiles",
        "min(j >> s[1], across - 1)",
        "min(j >> 1, across - 1)",
        "tiles-stopped",
    ),
    Mutant(
        "5: s of a coefficient's parent is 0 along an axis that has stopped",
        "tiles",
        "s = int(grid.stepped(level - 1, axis))",
        "s = 1",
        "tiles-stopped",
    ),
    Mutant(
        "5: s is of the step from level l - 1 to l - 2",
        "tiles",
        "s = int(grid.stepped(level - 1, axis))",
        "s = int(grid.stepped(level, axis))",
        "tiles-cut",
    ),
    Mutant(
        "5: nodes that are left out count in o",
        "tiles",
        "spans.append((low, slice(base + low, base + high)))",
        (
            "spans.append((low - (not kind[axis] and not attribute and bool(level) and grid.kept(level, "
            "axis)[0]), slice(base + low, base + high)))"
        ),
        "tiles-sides",
    ),
    Mutant(
        "5: a coefficient's parent is at ((o + s) >> s) - o' + (i >> s)",
        "tiles",
        "(share.origin[axis] + s) >> s",
        "share.origin[axis] >> s",
        "tiles-interface",
    ),
    Mutant(
        "5: units of indices are never large",
        "decoder",
        "<= self.tile(number).level and not indices",
        "<= self.tile(number).level",
        "strings-indices",
    ),
    # 6: layers
    Mutant(
        "6: bits 4 to 7 of an entry are units skipped; 15 and more go on",
        "container",
        "(fields.varint() if skipped == 15 else 0)",
        "0",
        "patches-channels",
    ),
    Mutant("6: 8 passes and more go on", "container", "fields.varint() if passes == 8 else 0", "0", "values-float32"),
    Mutant(
        "6: a unit that no layer names has only coefficients 0",
        "decoder",
        "decoder.states[-1] = decoder.remaining",
        "pass",
        "strings-missing",
    ),
    # 7.1 and 7.2: range coder
    Mutant(
        "7.1: four bytes of 255 count as 2^32 - 2",
        "range_coder",
        '"big"), 0xFFFFFFFE)',
        '"big"), 0xFFFFFFFF)',
        "strings-ones",
    ),
    Mutant(
        "7.1: `width` is renewed below 2^24",
        "range_coder",
        "while width < 1 << 24:",
        "while width < 1 << 16:",
        "values-float32",
    ),
    Mutant(
        "7.2: a probability is at least 32",
        "small_units",
        "(32 if scaled < 32 else",
        "(64 if scaled < 64 else",
        "limits-contexts",
    ),
    Mutant(
        "7.2: a probability is at most 65504",
        "small_units",
        "scaled if scaled < 65504 else 65504",
        "scaled",
        "several-tiles",
    ),
    Mutant("7.2: n is at most 127", "small_units", "if count < 127:", "if count < 126:", "sections-optional"),
    Mutant(
        "7.2: contexts start at n = 1",
        "range_coder",
        "[1 << 19] * count, [1] * count",
        "[1 << 19] * count, [2] * count",
        "values-float32",
    ),
    # 7.3: passes
    Mutant(
        "7.3: the last first pass of indices visits nothing",
        "small_units",
        "elif plane or not self.indices:",
        "else:",
        "levels-quantised",
    ),
    Mutant(
        "7.3: the state is 0 at each row of blocks",
        "small_units",
        "            state = 0\n            for j, block in enumerate(row):",
        "            state = state if i else 0\n            for j, block in enumerate(row):",
        "values-steps-most",
    ),
    Mutant(
        "7.3: later bits of an index are not raw in pass 0",
        "small_units",
        "if quantisers:\n                lists.odd[i] = state & 1",
        "if quantisers and context <= REFINEMENT:\n                lists.odd[i] = state & 1",
        "levels-quantised",
    ),
    # 7.4: contexts
    Mutant(
        "7.4: u is at most 3",
        "small_units",
        "u_ = min(magnitudes[i] >> plane, 3)",
        "u_ = min(magnitudes[i] >> plane, 4)",
        "sections-masks",
    ),
    Mutant("7.4: for kind 2 x and y swap", "small_units", "(row == 0) != (kind == 2)", "(row == 0)", "values-float32"),
    Mutant(
        "7.4: x has the classes 0; 1 and 2; 3 and more",
        "small_units",
        "side = np.array([0, 1, 1, 2,",
        "side = np.array([0, 1, 2, 2,",
        "values-float32",
    ),
    Mutant("7.4: f has the classes from 1, 4 and 12 on", "small_units", "(f >= 12)", "(f >= 13)", "values-float32"),
    Mutant(
        "7.4: the parent counts up to 4",
        "tiles",
        "3 * np.minimum(near, 4)",
        "3 * np.minimum(near, 3)",
        "levels-quantised",
    ),
    Mutant(
        "7.4: the parent's neighbours count up to 12",
        "tiles",
        "np.minimum(around, 12)",
        "np.minimum(around, 11)",
        "sections-optional",
    ),
    Mutant(
        "7.4: a parent just outside may have neighbours inside",
        "tiles",
        "part[1:-1, 1:-1] += np.minimum(around, 12)",
        "part[2:-2, 2:-2] += np.minimum(around, 12)[1:-1, 1:-1]",
        "values-float32",
    ),
    Mutant(
        "7.4: a sign's context has d = 3 v + h for kind 2",
        "small_units",
        "d = 3 * along + across if swap else",
        "d = 3 * across + along if swap else",
        "sections-optional",
    ),
    Mutant(
        "7.4: if d < 0 the bit of a sign is 1 for positive",
        "small_units",
        "sign_base + 3 * abs(d), d < 0, -1",
        "sign_base + 3 * abs(d), False, -1",
        "values-float32",
    ),
    Mutant(
        "7.4: g is at most 2",
        "bands",
        "np.minimum(parent, 2).tolist()",
        "np.minimum(parent, 1).tolist()",
        "values-float32",
    ),
    Mutant(
        "7.4: blocks after this one count in a flag's context",
        "bands",
        "return 3 * before + after",
        "return 3 * before",
        "levels-one-by-one",
    ),
    # 7.5: masks
    Mutant(
        "7.5: a group's context has the last such bit",
        "masks",
        "last = bit(2 * v + last)",
        "last = bit(2 * v)",
        "infinite-error",
    ),
    Mutant(
        "7.5: a group is surrounded by two rows",
        "masks",
        "and above[left - 2 : right + 2] == same:",
        ":",
        "infinite-error",
    ),
    Mutant(
        "7.5: a row's last group may be shorter",
        "masks",
        "right = min(left + 16, columns + 2)",
        "right = min(left + 15, columns + 2)",
        "holes-closed",
    ),
    # 7.6: large units
    Mutant(
        "7.6: stripes have 64 columns",
        "large_units",
        "stripe = (row >> 3) * across + (column >> 6)",
        "stripe = (row >> 3) * across + np.minimum(column >> 5, across - 1)",
        "large-sparse",
    ),
    Mutant(
        "7.6: signs come first where row plus column is even",
        "large_units",
        "for some in (new[odd == 0], new[odd == 1]):",
        "for some in (new[odd == 1], new[odd == 0]):",
        "strings-odd",
    ),
    Mutant(
        "7.6: a first pass makes no n above 16 stay",
        "large_units",
        "self.counts = np.minimum(self.counts, 16)",
        "pass",
        "strings-odd",
    ),
    Mutant(
        "7.6: n is at most 127",
        "large_units",
        "np.minimum(self.counts + k, 127)",
        "np.minimum(self.counts + k, 120)",
        "strings-odd",
    ),
    Mutant(
        "7.6: states below 2^16 count as 2^16",
        "large_units",
        'max(int.from_bytes(first[:4], "little"), 1 << 16)',
        'int.from_bytes(first[:4], "little")',
        "strings-states",
    ),
    Mutant(
        "7.6: the odd last byte of a segment is half a word",
        "large_units",
        'np.frombuffer(rest + b"\\0" * (len(rest) % 2), "<u2")',
        'np.frombuffer(rest[: len(rest) // 2 * 2], "<u2")',
        "strings-odd",
    ),
    Mutant(
        "7.6: q is at least 1",
        "large_units",
        "np.maximum(self.probabilities >> 4, 1)",
        "np.maximum(self.probabilities >> 4, 0)",
        "large-sparse",
    ),
    Mutant(
        "7.6: blocks whose flag is 1 in this pass are visited whole",
        "large_units",
        "visited[lo:hi] | self.new[striped.block_s[lo:hi]]",
        "visited[lo:hi]",
        "strings-odd",
    ),
    Mutant(
        "7.6: a weight is 3 for m of 2 and more",
        "large_units",
        "WEIGHTS = np.array([0, 2, 3], np.int16)",
        "WEIGHTS = np.array([0, 2, 2], np.int16)",
        "strings-odd",
    ),
    Mutant(
        "7.6: bits are raw from m = 2 on",
        "large_units",
        "self.context_s[self.m_s > 0] = REFINEMENT",
        "pass",
        "strings-odd",
    ),
    # 8: from coefficients to points
    Mutant(
        "8: r(p) = (7 << p) >> 4",
        "coefficients",
        "(known << plane) + ((7 << plane) >> 4)",
        "(known << plane) + ((8 << plane) >> 4)",
        "values-float32",
    ),
    Mutant(
        "8: a coefficient that became significant in pass n of an odd n",
        "coefficients",
        "if remaining & 1:",
        "if False:",
        "sections-optional",
    ),
    Mutant(
        "8: only coefficients of that very pass",
        "coefficients",
        "(magnitude >> low > 0) & band.early",
        "(magnitude >> low > 0)",
        "values-float32",
    ),
    Mutant(
        "8, step 1: the coefficients of level 0 need not be known",
        "decoder",
        "if tile.level and not header.empty",
        "if not header.empty",
        "levels-planes",
    ),
    Mutant(
        "8, step 1: the levels of `empty` are known",
        "decoder",
        "if tile.level and not header.empty[channel] >> tile.level & 1:",
        "if tile.level:",
        "tiles-interfaces",
    ),
    Mutant(
        "8, step 1: units without coefficients are known",
        "decoder",
        "if state[unit] and tile.shares[channel >= header.coordinates]:",
        "if state[unit]:",
        "levels-blocks",
    ),
    Mutant(
        "8, step 2: coefficients times 8 are clamped to 2^28",
        "reconstruction",
        "values = np.clip(8 * values, -(1 << 28), 1 << 28)",
        "values = 8 * values",
        "levels-planes",
    ),
    Mutant(
        "8, step 2: the levels above F are times 8",
        "reconstruction",
        "if tile.level > whole:",
        "if tile.level >= whole:",
        "values-float32",
    ),
    Mutant(
        "8, step 3: sides of patches take the points of interfaces after common ends",
        "reconstruction",
        "for end, holder in sorted(header.holders.items()):",
        "for end, holder in ():",
        "patches-attributes",
    ),
    Mutant(
        "8, step 4: level F is clamped to 2^24",
        "reconstruction",
        "lower[:] = 8 * np.clip(lower, -(1 << 24), 1 << 24)",
        "lower[:] = 8 * lower",
        "levels-clamps",
    ),
    Mutant(
        "8, step 4: level F is times 8 at l = F + 1",
        "reconstruction",
        "if upper == whole + 1:",
        "if upper == whole + 1 and not grid.interface:",
        "tiles-interface",
    ),
    Mutant(
        "8, step 4: details of a side are computed with the patch's (a, b)",
        "reconstruction",
        "_pair(header, channel, upper, number, along))[:, 0]",
        "_pair(header, channel, upper, interface, 0))[:, 0]",
        "tiles-interface",
    ),
    Mutant(
        "8, step 4: along axis 1 first",
        "reconstruction",
        "for axis in (1, 0):",
        "for axis in (0, 1):",
        "values-float32",
    ),
    Mutant(
        "8, step 1: F counts for a level K of a layer on the way too",
        "decoder",
        "whole = self._whole(channel, state, level)",
        "whole = self._whole(channel, state, level) if level == header.finest else level",
        "levels-heights",
    ),
    Mutant(
        "8, step 5: a point takes the attributes of the last patch",
        "decoder",
        "for grid, index in patches:",
        "for grid, index in patches[::-1]:",
        "patches-attributes",
    ),
    Mutant(
        "8: predictions where R >= 3 alone",
        "lifting",
        "if run < 3 or (a, b) == (0, 0):",
        "if run < 4 or (a, b) == (0, 0):",
        "values-float32",
    ),
    Mutant("8: v_k is rounded by 128", "lifting", "return (v + 128) >> 8", "return (v + 127) >> 8", "values-float32"),
    Mutant(
        "8: d is clamped to 2^28",
        "lifting",
        "_predicted(c, axis, pair), -LIMIT, LIMIT)",
        "_predicted(c, axis, pair), -2 * LIMIT, 2 * LIMIT)",
        "levels-clamps",
    ),
    Mutant(
        "8: x is clamped to 2^27",
        "lifting",
        "np.clip(x, -LIMIT // 2, LIMIT // 2)",
        "np.clip(x, -LIMIT, LIMIT)",
        "levels-clamps",
    ),
    Mutant(
        "8: unclamped x in x_{2k+1}",
        "lifting",
        "even = c - _update(d, axis)",
        "even = np.clip(c - _update(d, axis), -LIMIT // 2, LIMIT // 2)",
        "levels-clamps",
    ),
    Mutant("8: ten products in s_k", "lifting", "-21, 4, -1)", "-21, 4, 0)", "sections-optional"),
    Mutant(
        "8: the end of a run at a gap is never clamped",
        "lifting",
        "and not axis.closed and not axis.extra",
        "and not axis.closed",
        "levels-blocks",
    ),
    Mutant(
        "8: c is mirrored about the first node by quadratic continuation",
        "lifting",
        "for near, step in ((1, 1), (0, 1),",
        "for near, step in ((0, 1), (1, 1),",
        "strings-odd",
    ),
    Mutant(
        "8: [origin, step, scale] divides by the scale",
        "reconstruction",
        "return (origin + step * p) / float(last)",
        "return origin / float(last) + step / float(last) * p",
        "plane-steps",
    ),
    Mutant(
        "8: [origin, step, false] is step (p + 0.5) + origin",
        "reconstruction",
        "return step * (p + 0.5) + origin",
        "return step * p + (0.5 * step + origin)",
        "plane-centres",
    ),
    Mutant(
        "8: [origin, last, true] is just last at the end",
        "reconstruction",
        "np.where(p == n - 1, step, origin + p",
        "np.where(p == n, step, origin + p",
        "plane-centres",
    ),
    # 8.1: quantised coordinates
    Mutant(
        "8.1: S is at least 1",
        "coefficients",
        "return max(1, product >> 32)",
        "return product >> 32",
        "values-steps-least",
    ),
    Mutant("8.1: l' is at least 1", "coefficients", "lower = max(level, 1) - 1", "lower = level - 1", "error-blocks"),
    Mutant(
        "8.1: h halves W for steps beyond 5",
        "coefficients",
        "if steps > 5 else 0",
        "if steps > 6 else 0",
        "values-steps-least",
    ),
    Mutant(
        "8.1: axis 1 of an interface counts as stepping",
        "coefficients",
        "if grid.interface and axis == 1:",
        "if False:",
        "error-blocks",
    ),
    Mutant(
        "8.1: an index of Q1 is less by a half",
        "coefficients",
        "8 * (band.odd & (magnitude > 0))",
        "8 * band.odd",
        "levels-quantised",
    ),
    Mutant(
        "8.1: magnitudes are at most 2^28",
        "coefficients",
        "np.minimum(value * step >> 4, 1 << 28)",
        "value * step >> 4",
        "values-steps-most",
    ),
    # 9 to 9.2: residual
    Mutant(
        "9: a block's chunks of kept holes follow its own",
        "container",
        (
            "        for number, block in enumerate(header.blocks)\n"
            "        for kept in ((False, True) if masks.kept[number].any() else (False,))"
        ),
        (
            "        for kept in (False, True)\n"
            "        for number, block in enumerate(header.blocks)\n"
            "        if not kept or masks.kept[number].any()"
        ),
        "infinite-blocks",
    ),
    Mutant(
        "9.1: rule 2 clamps to 2^53 before rounding",
        "residual",
        "10.0**t, -(2.0**53), 2.0**53)",
        "10.0**t, -(2.0**62), 2.0**62)",
        "residual-decimals",
    ),
    Mutant(
        "9.1: rule 2 clamps places to 2^53",
        "residual",
        "np.clip(places, -(1 << 53), 1 << 53).astype",
        "places.astype",
        "residual-decimals",
    ),
    Mutant(
        "9.1: values of uint64 from 2^63 on count as value - 2^64",
        "residual",
        'if values.dtype.kind != "f":\n        return values.astype(np.int64) >> t, none',
        'if values.dtype.kind != "f":\n        return (values >> values.dtype.type(t)).astype(np.int64), none',
        "residual-uint64",
    ),
    Mutant(
        "9.1: a negative pattern has the place -1 - (m >> t)",
        "residual",
        "np.where(pattern >> high == 1, -1 - m, m), exponent",
        "np.where(pattern >> high == 1, -m, m), exponent",
        "residual-decimals",
    ),
    Mutant("9.1: m is shifted by t", "residual", "    m >>= t\n", "", "residual-decimals"),
    Mutant(
        "9.1: the exponent counts with rule 1",
        "residual",
        "np.clip((most & 4095) - exponents, 0, 63)",
        "np.full(len(values), min(most & 4095, 63))",
        "residual-decimals",
    ),
    Mutant(
        "9.2: limit is at most 63",
        "residual",
        "np.clip((most & 4095) - exponents, 0, 63)",
        "np.clip((most & 4095) - exponents, 0, 64)",
        "residual-decimals",
    ),
    Mutant(
        "9.2: the memory has 16384 entries",
        "residual",
        "np.uint64(16383)).tolist()",
        "np.uint64(4095)).tolist()",
        "curve",
    ),
    Mutant(
        "9.2: a special does not change the memory",
        "residual",
        "                which[i] = k - 1\n",
        "                which[i] = k - 1\n                memory_places[entry], memory[entry] = place, 0\n",
        "residual-decimals",
    ),
    Mutant(
        "9.2: a special's context has the last two such bits",
        "residual",
        "(2 * history + special) & 3",
        "special",
        "residual-decimals",
    ),
    Mutant(
        "9.2: the last special takes no bit",
        "residual",
        "while k < specials and bit(WHICH + k):",
        "while bit(WHICH + k) and k < specials:",
        "residual-decimals",
    ),
    Mutant(
        "9.2: z = y - 8 + w", "residual", "coder.tree(BESIDE, 4) - 8", "coder.tree(BESIDE, 4) - 7", "residual-decimals"
    ),
    Mutant(
        "9.2: `shorter` tells limits up to 15",
        "residual",
        "base = SHORTER + 16 * min(limit, 15)",
        "base = SHORTER + 16 * min(limit, 14)",
        "residual-decimals",
    ),
    Mutant(
        "9.2: more than 32 bits are taken in two numbers", "residual", "if r > 32:", "if r > 40:", "heights-int64-far"
    ),
    Mutant(
        "9.2: the entry of p then holds p and z",
        "residual",
        "memory_places[entry] = place\n        differences[i] = memory[entry] = z & MASK",
        (
            "differences[i] = z & MASK\n"
            "        if memory_places[entry] != place:\n"
            "            memory[entry] = z & MASK\n"
            "        memory_places[entry] = place"
        ),
        "residual-decimals",
    ),
    # 9.3: offsets
    Mutant("9.3: h is at most 15", "offsets", "min(history + 1, 15)", "min(history + 1, 14)", "residual-offsets"),
    Mutant("9.3: h is 0 after a 0", "offsets", "                history = 0\n", "", "residual-offsets"),
    Mutant(
        "9.3: a rank above all is the last",
        "offsets",
        "min(tree(WHICH, 6), len(intervals) - 1)",
        "tree(WHICH, 6) % len(intervals)",
        "residual-offsets",
    ),
    Mutant(
        "9.3: a list has 64 intervals",
        "offsets",
        "elif len(intervals) == 64:",
        "elif len(intervals) == 63:",
        "residual-offsets",
    ),
    Mutant(
        "9.3: the last of 64 is dropped",
        "offsets",
        "            intervals.pop()\n",
        "            intervals.pop(0)\n",
        "residual-offsets",
    ),
    Mutant(
        "9.3: the place of what is not finite is 0x7F7FFFFF",
        "offsets",
        "    if m > HIGHEST:\n        return HIGHEST\n",
        "    if m > HIGHEST:\n        return -1 - HIGHEST if pattern >> 31 else HIGHEST\n",
        "residual-offsets",
    ),
    Mutant(
        "9.3: what overflows float32 has the place 0x7F7FFFFF, of either sign",
        "offsets",
        "    except OverflowError:\n        return HIGHEST\n",
        "    except OverflowError:\n        return HIGHEST if value > 0 else -1 - HIGHEST\n",
        "residual-offsets-far",
    ),
    Mutant(
        "9.3: value(place) beyond the largest finite one is that one",
        "offsets",
        "pattern = min(place, HIGHEST) if place >= 0",
        "pattern = min(place, 0x7F800000) if place >= 0",
        "residual-offsets-far",
    ),
    Mutant(
        "9.3: value(place) below the least finite one is that one",
        "offsets",
        "0x80000000 | min(-1 - place, HIGHEST)",
        "0x80000000 | min(-1 - place, 0x7F800000)",
        "residual-offsets",
    ),
    Mutant(
        "9.3: if bottom > top both are f - base", "offsets", "bottom = top = value - base", "pass", "residual-offsets"
    ),
    Mutant(
        "9.3: bottom and top are narrowed by the entry",
        "offsets",
        "bottom, top = max(bottom, low), min(top, high)",
        "pass",
        "residual-offsets",
    ),
    Mutant(
        "9.3: the place is clamped to 32 bits with a sign",
        "offsets",
        "found = np.clip(np.array(restored, np.int64), -(1 << 31), (1 << 31) - 1)",
        "found = np.array(restored, np.int64)",
        "residual-offsets",
    ),
    Mutant(
        "9.3: bits from the fifth on have contexts `new` 12 + j",
        "offsets",
        "bit(NEW + 12 + j)",
        "bit(NEW + 11 + j)",
        "residual-offsets",
    ),
    Mutant(
        "9.3: `off` is 8 (k > 0) + v", "offsets", "tree(OFF + 8 * (rank > 0), 3)", "tree(OFF, 3)", "residual-offsets"
    ),
    Mutant(
        "9.3: the place is counted from floor(2^B / 2) below",
        "offsets",
        "((1 << bits) >> 1)",
        "(1 << bits >> 1) + (bits == 0)",
        "residual-offsets",
    ),
    # 11: index
    Mutant(
        "11: layers skipped from 31 on go on",
        "index",
        "(fields.varint() if skipped == 31 else 0)",
        "0",
        "sections-layers",
    ),
    Mutant(
        "11: segments of 8 passes and more go on",
        "index",
        "fields.varint() if passes == 8 else 0",
        "0",
        "sections-optional",
    ),
    Mutant("11: a page tells of 256 tiles", "index", "PAGE = 256", "PAGE = 128", "sections-pages"),
    Mutant(
        "11: optional sections stand between the others",
        "index",
        (
            "        while position in optional:\n"
            "            position += optional.pop(position)\n"
            "        position += length"
        ),
        (
            "        position += length\n"
            "        while position in optional:\n"
            "            position += optional.pop(position)"
        ),
        "sections-optional",
    ),
)
