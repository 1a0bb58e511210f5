// Shared by all parts of the page: the data, the state, and small helpers. Text that
// comes from files reaches the page as text nodes only, never as markup.

const DATA = JSON.parse(await unpacked("data"));
const FLAT = DATA.dim === 2;
const SCANS = DATA.kind === "scans";
// Of lengths, if it was told: beside every one.
const UNIT = DATA.details.unit || "";
const CONFIG = { responsive: true, displayModeBar: false, scrollZoom: true };
const FAR_COLOR = [139, 144, 150];
// Blue where scans agree, red at the end of the scale.
const HEAT = [[49, 104, 172], [72, 163, 178], [226, 196, 92], [222, 122, 56], [190, 38, 46]];

const state = {
  when: "after", // or "before"
  color: "scan", // or "distance"
  shown: SCANS ? DATA.scans.map(() => true) : { chain: true, loops: true, off: true },
  only: null, // a pair of scans that is shown alone
  own: false, // whether by its own motion, not by the final poses
  model: 0, // the component that is shown
  mode: 0,
  axis: 0,
  cut: 0.5,
  edge: null, // an edge of a graph that is drawn thick
  marks: { trusted: true, off: true }, // control points that are shown
};
const NUM_MODELS = SCANS ? 1 + Math.max(0, ...DATA.scans.map((s) => s.component)) : 1;
const listeners = [];

function change(part) {
  if ("only" in part && !("own" in part)) state.own = false;
  Object.assign(state, part);
  for (const listener of listeners) listener(part);
}

function inUnit(name) { return UNIT ? `${name} [${UNIT}]` : name; }

// Residuals, errors and deviations of scans in metres are told in millimetres.
const [FINE, FINER] = UNIT === "m" ? ["mm", 1000] : [UNIT, 1];

function inFine(name) { return FINE ? `${name} [${FINE}]` : name; }

function fine(x, digits) { return number(typeof x === "number" ? FINER * x : x, digits); }

function asFine(x, digits) { return FINE ? `${fine(x, digits)} ${FINE}` : fine(x, digits); }

function $(id) { return document.getElementById(id); }

function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "style") node.style.cssText = value;
    else if (key === "onclick") node.addEventListener("click", value);
    else if (value !== null && value !== false) node.setAttribute(key, value);
  }
  node.append(...children.map((c) => (c instanceof Node ? c : String(c))));
  return node;
}

function svg(tag, attributes = {}) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  return node;
}

function decode(text, Kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Kind(bytes.buffer);
}

function number(x, digits = 4) {
  if (x === null || x === undefined) return "–";
  if (x === 0) return "0";
  const size = Math.abs(x);
  if (size >= 1e6 || size < 1e-4) return x.toExponential(digits - 1).replace("e+", "e");
  return String(Number(x.toPrecision(Math.max(digits, Math.ceil(Math.log10(size))))));
}

// So many decimals that rows of coordinates differ in six digits, however far they lie.
function decimals(rows) {
  const spread = Math.max(0, ...rows[0].map((_, a) => {
    const values = rows.map((r) => r[a]);
    return values.reduce((x, y) => Math.max(x, y)) - values.reduce((x, y) => Math.min(x, y));
  }));
  return spread > 0 ? Math.min(Math.max(5 - Math.floor(Math.log10(spread)), 0), 9) : 6;
}

// In words of a finger where there is no mouse.
function howToMove() {
  const touch = matchMedia("(pointer: coarse)").matches;
  const zoom = touch ? "pinch to zoom" : "wheel to zoom";
  if (FLAT) return `Drag to move, ${zoom}.`;
  return `Drag to turn, ${zoom}${touch ? "" : ", right button to move"}.`;
}

function degrees(x) { return x === null || x === undefined ? null : (x * 180) / Math.PI; }
function rgb(c) { return `rgb(${c.map((x) => Math.round(x)).join(",")})`; }
function mix(a, b, t) { return a.map((x, k) => x + (b[k] - x) * t); }
function theme(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function heat(code) {
  if (code === 255) return FAR_COLOR;
  const t = (code / 254) * (HEAT.length - 1);
  const k = Math.min(Math.floor(t), HEAT.length - 2);
  return mix(HEAT[k], HEAT[k + 1], t - k);
}

// A row of buttons of which one is pressed; a click sets `also`, too.
function choice(id, options, key, also = {}) {
  const box = $(id);
  const buttons = options.map(([value, label]) => {
    const button = el("button", { type: "button", "data-value": value }, label);
    button.addEventListener("click", () => change({ [key]: value, ...also }));
    box.append(button);
    return button;
  });
  const update = () => {
    for (const b of buttons) {
      b.setAttribute("aria-pressed", String(b.dataset.value === String(state[key])));
    }
  };
  listeners.push(update);
  update();
}

function tile(value, label, kind = "") {
  const node = el("div", { class: "tile" }, el("b", { class: kind }, value), el("span", {}, label));
  $("tiles").append(node);
}
