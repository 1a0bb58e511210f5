// How the method came to rest: one small drawing beside the other.

const LINE_COLORS = ["--accent", "--bad"];

function curveLayout(curves, panels) {
  const wide = $("curves").clientWidth > 640;
  const layout = {
    margin: { l: 52, r: 10, t: 26, b: 44 }, hovermode: "x unified", showlegend: false,
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: theme("--soft"), size: 11 },
    hoverlabel: { bgcolor: theme("--card"), font: { color: theme("--ink") } },
    grid: { rows: wide ? 1 : panels.length, columns: wide ? panels.length : 1, pattern: "independent",
      xgap: 0.16, ygap: 0.3 },
    annotations: [],
  };
  panels.forEach((panel, k) => {
    const id = k ? k + 1 : "";
    const few = panel.lines[0].y.length <= 10;
    layout[`xaxis${id}`] = { title: { text: curves.x }, gridcolor: theme("--line"), zeroline: false,
      ...(few ? { dtick: 1 } : {}) };
    layout[`yaxis${id}`] = { type: panel.log ? "log" : "linear", gridcolor: theme("--line"), zeroline: false,
      exponentformat: "power", nticks: 6, ...(panel.log ? {} : { rangemode: "tozero" }) };
    const names = panel.lines.map(({ name }, n) => `<span style="color:${theme(LINE_COLORS[n])}">${name}</span>`);
    const title = panel.title + (names.length > 1 ? `: ${names.join(", ")}` : "");
    const text = title.replace(/\[unit( of the input)?\]/, `[${UNIT || "unit of the input"}]`);
    layout.annotations.push({ text, showarrow: false, xref: `x${id} domain`, yref: `y${id} domain`,
      x: 0, y: 1, yanchor: "bottom", xanchor: "left", font: { color: theme("--ink"), size: 12 } });
  });
  return layout;
}

function startCurves() {
  const curves = DATA.curves;
  if (!curves) return;
  $("curves-card").hidden = false;
  $("curves-note").textContent = curves.note;
  const panels = curves.panels;
  $("curves").hidden = !panels.length;
  if (!panels.length) return;
  const draw = () => {
    const traces = panels.flatMap((panel, k) => panel.lines.map((line, n) => {
      // Zero has no place on a scale of powers: a step that changed nothing is left out.
      const y = panel.log ? line.y.map((v) => (v > 0 ? v : null)) : line.y;
      return {
        type: "scatter", mode: y.length > 60 ? "lines" : "lines+markers", name: line.name,
        x: y.map((_, row) => row + curves.first), y,
        xaxis: `x${k ? k + 1 : ""}`, yaxis: `y${k ? k + 1 : ""}`,
        connectgaps: true, line: { color: theme(LINE_COLORS[n]), width: 2 }, marker: { size: 5 },
      };
    }));
    return Plotly.react("curves", traces, curveLayout(curves, panels), { ...CONFIG, scrollZoom: false });
  };
  draw();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
}
