// Control points: where they were surveyed, and where the poses put them.

const MARKS = [
  ["trusted", "Control points, trusted", "--good"],
  ["off", "Control points, not trusted", "--bad"],
];
// Farther marks, in longest sides of the model, do not make the model small at first,
// and the farthest are not drawn at all.
const [MARK_NEAR, MARK_FAR] = [1.5, 50];
const MAX_LABELS = 60;

function markKind(p) { return p.weight > 0.5 ? "trusted" : "off"; }

// Whether it is farther off than its deviation allows, trusted or not: where too few
// points speak against a wrong one, all bend to it.
function isWide(p) { return p.normalised > 3; }

// Where the pose puts a point, in the world, in float64 like what was surveyed.
function putAt(p) { return p.surveyed.map((x, a) => x + p.residual[a]); }

// Whether what is drawn lies in the world of the control points.
function inWorld() {
  return state.when === "after" && (!SCANS || (state.model === 0 && !state.own));
}

function shownMarks() {
  if (!inWorld()) return [];
  return DATA.control.filter((p) =>
    state.marks[markKind(p)] && !(SCANS && state.only && !state.only.includes(p.i)));
}

// Both ends of the lines, about the middle of the box, that lie within some sides of it.
function marksNear({ box, origin }, sides) {
  if (!inWorld()) return [];
  const most = sides * Math.max(...box.map(([low, high]) => high - low), 1e-12);
  const ends = DATA.control.flatMap((p) => (p.residual ? [p.surveyed, putAt(p)] : [p.surveyed]));
  return ends.map((x) => x.map((c, a) => c - origin[a] - (box[a][0] + box[a][1]) / 2))
    .filter((x) => x.every((c) => Math.abs(c) < most));
}

// How far marks reach from the middle of the box, seen along one direction.
function markReach(view, direction, longest) {
  const along = (x) => Math.abs(x.reduce((s, c, a) => s + c * direction[a], 0));
  return Math.max(0, ...marksNear(view, MARK_NEAR).map(along)) / longest;
}

// Half the sides of the drawing about the middle of the box, so long as marks need.
function halfSides(view, half) {
  const marks = marksNear(view, FLAT ? MARK_NEAR : MARK_FAR);
  return half.map((h, a) => Math.max(h, ...marks.map((x) => 1.04 * Math.abs(x[a]))));
}

function markTitle(p) {
  const off = p.residual ? `off by ${asFine(p.length, 3)}` : "not placed";
  const trust = p.weight > 0.5 ? "trusted" : "not trusted";
  return `${markName(p)}: ${frameOf(p)}, ${off}, ${trust}`;
}

// As its table has it, else by its number.
function markName(p) { return p.name || p.number; }

function frameOf(p) { return SCANS ? DATA.scans[p.i].name : DATA.names[p.i]; }

// Places that are marked: a target may be seen from many frames.
function markPlaces() {
  const places = new Map();
  for (const p of shownMarks()) {
    const key = p.surveyed.join();
    places.set(key, [...(places.get(key) || []), p]);
  }
  return [...places.values()].map((points) => ({
    at: points[0].surveyed,
    color: theme(points.some((p) => p.weight > 0.5) ? "--good" : "--bad"),
    names: [...new Set(points.map(markName))].join(", "),
    title: points.map(markTitle).join("<br>"),
  }));
}

function markTraces({ origin }) {
  if (!DATA.control.length) return [];
  const points = shownMarks();
  const places = markPlaces();
  const about = (x) => x.map((c, a) => c - origin[a]);
  const drawn = (rows, more) => ({
    type: FLAT ? "scattergl" : "scatter3d", showlegend: false, visible: rows.length > 0,
    x: rows.map((r) => r[0]), y: rows.map((r) => r[1]),
    ...(FLAT ? {} : { z: rows.map((r) => r[2]) }), ...more,
  });
  const gap = Array(DATA.dim).fill(null);
  const lines = MARKS.map(([kind, , color]) => {
    const some = points.filter((p) => p.residual && markKind(p) === kind);
    return drawn(some.flatMap((p) => [about(p.surveyed), about(putAt(p)), gap]), {
      mode: "lines", hoverinfo: "skip", line: { color: theme(color), width: FLAT ? 2 : 6 } });
  });
  return [...lines, drawn(places.map((m) => about(m.at)), {
    mode: "markers", hoverinfo: "text", hovertext: places.map((m) => m.title),
    marker: { symbol: "diamond", size: FLAT ? 11 : 7, color: places.map((m) => m.color),
      line: { color: theme("--card"), width: 1 } },
  })];
}

// Numbers of the marks, before everything: surfaces hide what lies in them.
function markLabels({ origin }) {
  const places = markPlaces();
  if (places.length > MAX_LABELS) return [];
  return places.map(({ at, color, names }) => ({
    ...Object.fromEntries(at.map((c, a) => [AXES[a], c - origin[a]])),
    text: names, font: { color: theme("--ink"), size: 12 }, bgcolor: theme("--card"),
    bordercolor: color, borderpad: 2, arrowcolor: color, arrowwidth: 1.5, arrowhead: 6,
    arrowsize: 0.8, ax: 0, ay: -24,
  }));
}

// What is beyond the first view, in words.
function markHint(view) {
  if (!DATA.control.length) return "";
  const all = DATA.control.reduce((sum, p) => sum + (p.residual ? 2 : 1), 0);
  const far = marksNear(view, MARK_NEAR).length < all;
  return " Diamonds: control points as surveyed; lines: to where the poses put them."
    + (SCANS ? " Surfaces hide them: switch scans off." : "")
    + (far ? " Some lie outside of this view: zoom out." : "");
}

function markList() {
  for (const [kind, label, color] of MARKS) {
    const count = DATA.control.filter((p) => markKind(p) === kind).length;
    if (!count) continue;
    const box = el("input", { type: "checkbox", "data-marks": kind });
    box.checked = true;
    box.addEventListener("change", () => change({ marks: { ...state.marks, [kind]: box.checked } }));
    $("marks").hidden = false;
    $("marks").append(el("label", { class: "row" }, box,
      el("span", { class: "diamond", style: `background:var(${color})` }),
      el("span", { class: "name" }, label), el("small", {}, count.toLocaleString("en"))));
  }
}

function controlTile() {
  if (!DATA.control.length) return;
  const trusted = DATA.control.filter((p) => p.weight > 0.5).length;
  const all = DATA.control.length;
  tile(`${trusted} of ${all}`, "control points trusted",
    trusted < all || DATA.control.some(isWide) ? "warn" : "");
}

function startControl() {
  const points = DATA.control;
  if (!points.length) return;
  $("control-card").hidden = false;
  const axes = AXES.slice(0, DATA.dim);
  const what = SCANS ? "scan" : "frame";
  const normalised = points.some((p) => p.normalised !== null);
  const heads = ["point", what, ...axes.map((a) => inUnit(`${a} in ${what}`)),
    ...axes.map((a) => inUnit(`${a} surveyed`)), ...axes.map((a) => inFine(`Δ${a}`)),
    inFine("length"), ...(normalised ? ["normalised"] : []), "trust", "used"];
  const own = decimals(points.map((p) => p.point));
  const world = decimals(points.map((p) => p.surveyed));
  const order = [...points].sort((p, q) => (q.length ?? Infinity) - (p.length ?? Infinity));
  const rows = order.slice(0, 500).map((p) => ({
    title: markTitle(p),
    cells: [markName(p), frameOf(p), ...p.point.map((x) => x.toFixed(own)),
      ...p.surveyed.map((x) => x.toFixed(world)),
      ...(p.residual || axes.map(() => null)).map((x) => fine(x, 3)), fine(p.length, 3),
      ...(normalised ? [el("span", { class: isWide(p) ? "warn" : "" }, number(p.normalised, 3))] : []),
      number(p.weight, 2),
      p.weight > 0.5 ? "yes" : el("span", { class: "bad" }, "no")],
  }));
  const more = points.length > rows.length ? ` The first ${rows.length} of ${points.length}; result.json holds all.` : "";
  $("control-note").textContent = "Δ is where the pose puts the point less where it was surveyed, along the axes "
    + `of the world.${normalised ? " Normalised: in standard deviations." : ""} Farthest off first.${more}`;
  $("control").append(table(heads, rows));
}
