// Header, tables, and the start of the page.

function table(heads, rows) {
  const head = el("tr", {}, ...heads.map((h) => el("th", {}, h)));
  const body = rows.map((row) => {
    const line = el("tr", row.onclick ? { class: "link", onclick: row.onclick } : {},
      ...row.cells.map((c) => el("td", {}, c)));
    if (row.title) line.title = row.title;
    return line;
  });
  return el("table", {}, el("thead", {}, head), el("tbody", {}, ...body));
}

// Rotation vector in degrees, from a rotation matrix in the corner of T.
function turnOf(T) {
  if (FLAT) return [degrees(Math.atan2(T[1][0], T[0][0]))];
  const axis = [T[2][1] - T[1][2], T[0][2] - T[2][0], T[1][0] - T[0][1]];
  const [sine, cosine] = [Math.hypot(...axis) / 2, (T[0][0] + T[1][1] + T[2][2] - 1) / 2];
  const angle = Math.atan2(sine, cosine);
  if (sine > 1e-6) return axis.map((a) => degrees((a * angle) / (2 * sine)));
  if (cosine > 0) return [0, 0, 0];
  // Half a turn: the axis is the largest column of T + I.
  const k = [0, 1, 2].reduce((m, i) => (T[i][i] > T[m][m] ? i : m), 0);
  const column = [0, 1, 2].map((i) => T[i][k] + (i === k ? 1 : 0));
  const length = Math.hypot(...column);
  return column.map((c) => (180 * c) / length);
}

function fixed(x, digits) { return x === null || x === undefined ? "–" : x.toFixed(digits); }

function isPlaced(s) { return SCANS ? s.component >= 0 : s.placed; }

function posesTable() {
  const rows = DATA.scans;
  const withStatus = SCANS;
  const withSigma = rows.some((s) => s.sigma[0] !== null);
  const withErrors = rows.some((s) => s.e_R !== undefined);
  const names = AXES.slice(0, DATA.dim);
  const turns = FLAT ? ["angle [°]"] : names.map((a) => `r${a} [°]`);
  const heads = [SCANS ? "scan" : "frame", ...(withStatus ? ["status"] : []),
    ...names.map((a) => inUnit(`t${a}`)), ...turns,
    ...(withSigma ? [inFine("σ position"), "σ angle [°]"] : []),
    ...(withErrors ? [inFine("error t"), "error R [°]"] : [])];
  const places = rows.filter(isPlaced).map((s) => names.map((_, a) => s.T[a][DATA.dim]));
  const digits = places.length ? decimals(places) : 6;
  const body = rows.map((s) => {
    const name = el("span", {}, ...(s.color
      ? [el("span", { class: "dot", style: `background:${rgb(s.color)}` })] : []), s.name);
    const t = names.map((_, a) => (isPlaced(s) ? s.T[a][DATA.dim].toFixed(digits) : "–"));
    const r = isPlaced(s) ? turnOf(s.T).map((x) => x.toFixed(3)) : turns.map(() => "–");
    const status = s.status + (isPlaced(s) ? s.component ? `, component ${s.component}` : "" : ", not placed");
    return { title: s.name, cells: [name, ...(withStatus ? [status] : []), ...t, ...r,
      ...(withSigma ? [fine(s.sigma[0], 2), fixed(degrees(s.sigma[1]), 4)] : []),
      ...(withErrors ? [fine(s.e_t, 3), fixed(degrees(s.e_R), 4)] : [])] };
  });
  if (withErrors) {
    body.push({ cells: ["mean", ...heads.slice(1, -2).map(() => ""),
      fine(DATA.errors.mean_e_t, 3), fixed(degrees(DATA.errors.mean_e_R), 4)] });
  }
  const more = SCANS || DATA.num_poses <= rows.length ? ""
    : ` The first ${rows.length} of ${DATA.num_poses}; poses.tum holds all.`;
  const noise = DATA.sigma_by || "what the trusted pairs show as noise";
  const sigma = withSigma ? ` σ is by ${noise}.` : "";
  $("poses-note").textContent = "From each frame to the common one: translation in " +
    `${UNIT || "the unit of the input"}, rotation ${FLAT ? "angle" : "vector"} in degrees.${sigma}${more}`;
  $("poses").append(table(heads, body));
}

function header() {
  $("title").textContent = DATA.title;
  const { name, advice } = DATA.status;
  tile(name, "status", name === "CONVERGED" ? "good" : "warn");
  if (name !== "CONVERGED") {
    $("advice").hidden = false;
    $("advice").textContent = advice;
  }
  if (SCANS) {
    const placed = DATA.scans.filter((s) => s.component === 0).length;
    if (DATA.scans.length > 2) {
      const trusted = DATA.pairs.filter((p) => p.weight > 0.5).length;
      tile(`${placed} of ${DATA.scans.length}`, "scans placed", placed < DATA.scans.length ? "warn" : "");
      tile(`${trusted} of ${DATA.pairs.length}`, "pairs trusted");
      if (NUM_MODELS > 1) tile(NUM_MODELS, "components, each in a frame of its own", "warn");
    } else if (DATA.pairs.length) {
      tile(number(DATA.pairs[0].overlap, 3), "overlap");
      tile(asFine(DATA.pairs[0].rmse, 3), "inlier RMSE");
    }
    if (DATA.errors) {
      tile(asFine(DATA.errors.mean_e_t, 3), "mean error of position");
      tile(`${number(degrees(DATA.errors.mean_e_R), 3)}°`, "mean error of rotation");
    }
  } else {
    tile(`${DATA.num_placed.toLocaleString("en")} of ${DATA.num_poses.toLocaleString("en")}`, "poses placed");
    tile(`${DATA.num_trusted.toLocaleString("en")} of ${(decode(DATA.weight, Float32Array).length).toLocaleString("en")}`, "edges trusted");
    if (DATA.details.objective_after !== undefined) {
      tile(`${number(DATA.details.objective_before)} → ${number(DATA.details.objective_after)}`, "objective, before → after");
    }
    tile(DATA.steps, "steps");
    tile(number(DATA.residual, 3), "mean residual");
    if (DATA.kernel_width[0] !== null) {
      tile(`${number(DATA.kernel_width[0], 3)}, ${number(degrees(DATA.kernel_width[1]), 3)}°`, "kernel width");
    }
  }
  controlTile();
  priorsTile();
}

function details() {
  const box = $("details");
  const { command, seed, settings = {}, times_s: times = {}, versions = {} } = DATA.details;
  if (command) {
    box.append(el("p", { class: "note" }, "This command repeats it:"), el("code", { id: "command" }, command));
  }
  const list = el("dl");
  const add = (key, value) => list.append(el("dt", {}, key), el("dd", {}, value));
  if (seed !== undefined) add("seed", seed);
  for (const [key, value] of Object.entries(settings)) add(key, value);
  const clock = Object.entries(times).map(([k, s]) => `${k} ${s.toFixed(1)} s`);
  if (clock.length) add("times", clock.join(", "));
  for (const [key, value] of Object.entries(versions)) add(key === "device" ? "computed on" : key, value);
  box.append(list);
}

header();
posesTable();
details();
(SCANS ? startScans() : startGraph()).then(() => {
  if (SCANS && !FLAT) startSection();
  startControl();
  startPriors();
  startResiduals();
  startCurves();
  if (SCANS && DATA.pairs.length && DATA.scans.length > 2) startPairs();
  else $("section-card").classList.add("full");
  // Colours of the drawings follow when the system turns dark or light.
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => change({}));
  document.body.dataset.ready = "yes";
});
