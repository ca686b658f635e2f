// The table of a cohort's subjects, with sorting and filtering, their pictures, and distributions of their numbers.
// All texts are inserted as text, never as markup; only the rows of one page of the table are drawn.

const data = JSON.parse(document.getElementById("data").textContent);
const [KEY, STATUS, REASON, FLAGS, FLAG_COUNT, MESH, FILES, FIRST] = [0, 1, 2, 3, 4, 5, 6, 7]; // of a row
const PAGE_ROWS = 20; // drawn at once in the table, and without it: either is four screens high
const PAGE_TILES = 48;
const BINS = 24;
const CHART = { width: 230, height: 74 };
// Subjects to look at first; failed ones have their own table above.
const STATUSES = ["violated", "done", "missing", "failed"];
const WORDS = { failed: "failed", missing: "not run", violated: "requirement violated", done: "done" };
const STEPS = {
  mm: data.volume === "mm^2" ? [[1e2, "cm²"], [1, "mm²"]] : [[1e6, "l"], [1e3, "ml"], [1, "mm³"]],
  bytes: [[1e9, "GB"], [1e6, "MB"], [1, "bytes"]],
  s: [[3600, "h"], [60, "min"], [1, "s"]],
  degrees: [[1, "°"]],
};
const charts = document.getElementById("charts");
const controls = document.getElementById("controls");
const place = document.getElementById("subjects");
const narrow = window.matchMedia("(max-width: 700px)");
const shown = new Set(data.columns.map((column, c) => (column.isFirst ? c : -1)).filter((c) => c >= 0));
const state = { text: "", only: "all", view: "table", sort: null, isDown: false, page: 0, bins: new Map() };
let order = [];

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function drawing(name, attributes, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

const isNumber = (value) => typeof value === "number";
const valueOf = (row, c) => row[FIRST + c];

function written(value, unit, digits = 3) {
  if (!isNumber(value)) return value === null || value === "" ? "–" : String(value);
  const steps = STEPS[unit] || [[1, ""]];
  const [factor, word] = steps.find(([least]) => Math.abs(value) >= least) || steps[steps.length - 1];
  const number = value / factor;
  const text = Number.isInteger(number) ? number.toLocaleString("en") : String(Number(number.toPrecision(digits)));
  return word === "°" ? text + word : word ? `${text} ${word}` : text;
}

// ---------------------------------------------------------------------------------------------------------------------
// Selection and order of rows

const collator = new Intl.Collator("en", { numeric: true });

function isIn(row) {
  if (state.only === "odd" ? !row[FLAG_COUNT] && row[STATUS] === "done" : state.only !== "all" && row[STATUS] !== state.only)
    return false;
  for (const [c, bin] of state.bins) if (!bin.holds(valueOf(row, c))) return false;
  return !state.text || textOf(row).includes(state.text);
}

const texts = new Map(); // of rows, in lower case, computed once
function textOf(row) {
  if (!texts.has(row)) {
    const values = row.slice(FIRST).filter((value) => typeof value === "string");
    const flags = row[FLAGS].map(([words]) => words);
    texts.set(row, [row[KEY], WORDS[row[STATUS]], row[REASON], ...flags, ...values].join("\n").toLowerCase());
  }
  return texts.get(row);
}

function compared(a, b) {
  if (state.sort === null) {
    const rank = (row) => STATUSES.indexOf(row[STATUS]);
    return rank(a) - rank(b) || b[FLAG_COUNT] - a[FLAG_COUNT];
  }
  const [x, y] = [a, b].map((row) => (state.sort < 0 ? row[KEY] : valueOf(row, state.sort)));
  if (x === null || y === null) return (x === null) - (y === null); // last, in either order
  const difference = isNumber(x) && isNumber(y) ? x - y : collator.compare(String(x), String(y));
  return state.isDown ? -difference : difference;
}

function update(isSamePage) {
  order = data.rows.map((_, r) => r).filter((r) => isIn(data.rows[r]));
  order.sort((a, b) => compared(data.rows[a], data.rows[b]) || a - b);
  if (!isSamePage) state.page = 0;
  draw();
}

// ---------------------------------------------------------------------------------------------------------------------
// The table, and the view with pictures only

function link(path, words) {
  return element("a", { href: path.split("/").map(encodeURIComponent).join("/"), textContent: words });
}

function linksOf(row) {
  const folder = row[KEY].split("_").join("/");
  const paths = { n: [`${folder}/${row[KEY]}_desc-tetopt_mesh.json`, "numbers"], l: [`logs/${row[KEY]}.log`, "log"],
    f: [`${folder}/figures`, "pictures"] };
  const links = row[MESH] ? [link(row[MESH], "mesh")] : [];
  for (const [letter, [path, words]] of Object.entries(paths)) if (row[FILES].includes(letter)) links.push(link(path, words));
  return links.flatMap((each) => [each, " "]);
}

function pictureOf(r) {
  const row = data.rows[r];
  const path = `${row[KEY].split("_").join("/")}/figures/thumbnail.png`;
  if (data.pictures[r]) {
    const image = element("img", { src: `data:image/png;base64,${data.pictures[r]}`, alt: `slices of ${row[KEY]}` });
    return element("a", { href: path, className: "picture" }, image);
  }
  return row[FILES].includes("t") ? link(path, "picture") : "";
}

function oddOf(row) {
  const own = row[FLAGS].filter(([, column]) => column !== "violated"); // its reason states this
  const words = own.map(([each]) => element("div", { className: "flag", textContent: each }));
  if (row[FLAG_COUNT] > row[FLAGS].length) words.push(element("div", { textContent: `and ${row[FLAG_COUNT] - row[FLAGS].length} more` }));
  if (row[STATUS] !== "done") words.unshift(element("div", { className: "bad", textContent: row[REASON] }));
  return words;
}

function nameOf(row) {
  const badge = element("span", { className: `badge ${row[STATUS]}`, textContent: WORDS[row[STATUS]] });
  return element("div", { className: "name" }, element("b", { textContent: row[KEY] }), " ", badge);
}

function heading(words, c, about) {
  const isSorted = state.sort === c;
  const button = element("button", { textContent: words + (isSorted ? (state.isDown ? " ▼" : " ▲") : ""), title: about });
  button.onclick = () => {
    [state.isDown, state.sort] = isSorted ? [!state.isDown, state.isDown ? null : c] : [false, c];
    update();
  };
  const cell = element("th", { scope: "col" }, button);
  if (isSorted) cell.setAttribute("aria-sort", state.isDown ? "descending" : "ascending");
  return cell;
}

function tableOf(rows) {
  const columns = [...shown].sort((a, b) => a - b);
  const odd = element("th", { scope: "col", textContent: "flags" });
  const heads = columns.map((c) => heading(data.columns[c].title, c, data.columns[c].about));
  const head = element("tr", {}, heading("subject", -1, "By name"), odd, ...heads, element("th", { textContent: "files" }));
  const body = rows.map((r) => {
    const row = data.rows[r];
    const flagged = new Set(row[FLAGS].map(([, column]) => column));
    const cells = columns.map((c) => {
      const cell = element("td", { textContent: written(valueOf(row, c), data.columns[c].unit) });
      if (flagged.has(data.columns[c].name)) cell.className = "flag";
      return cell;
    });
    const first = element("td", {}, nameOf(row), pictureOf(r));
    return element("tr", {}, first, element("td", { className: "odd" }, ...oddOf(row)), ...cells, element("td", {}, ...linksOf(row)));
  });
  return element("div", { className: "wide" },
    element("table", { className: "subjects" }, element("thead", {}, head), element("tbody", {}, ...body)));
}

function tilesOf(rows) {
  const tiles = rows.map((r) => {
    const row = data.rows[r];
    const isOdd = row[FLAG_COUNT] || row[STATUS] !== "done";
    return element("div", { className: isOdd ? "tile odd" : "tile" }, nameOf(row), pictureOf(r), ...oddOf(row));
  });
  return element("div", { className: "tiles" }, ...tiles);
}

function draw() {
  const size = state.view === "table" ? PAGE_ROWS : PAGE_TILES;
  const last = Math.max(Math.ceil(order.length / size) - 1, 0);
  state.page = Math.min(state.page, last);
  const rows = order.slice(state.page * size, (state.page + 1) * size);
  const pager = () => {
    const turn = (words, by) => {
      const button = element("button", { textContent: words, disabled: state.page + by < 0 || state.page + by > last });
      button.onclick = () => { state.page += by; draw(); place.scrollIntoView(); };
      return button;
    };
    const words = rows.length ? `${state.page * size + 1} to ${state.page * size + rows.length} of ${order.length}` : "no subject";
    const all = order.length < data.rows.length ? ` (${data.rows.length} in all)` : "";
    return element("div", { className: "pager" }, turn("‹ before", -1), ` ${words}${all} `, turn("next ›", 1));
  };
  const pagers = last ? [pager(), pager()] : [pager()];
  place.replaceChildren(pagers[0], state.view === "table" ? tableOf(rows) : tilesOf(rows), ...pagers.slice(1));
  drawChips();
}

// ---------------------------------------------------------------------------------------------------------------------
// Distributions

function binsOf(c) {
  const column = data.columns[c];
  const values = data.rows.map((row) => valueOf(row, c)).filter((value) => value !== null);
  if (values.some((value) => !isNumber(value))) {
    const counts = new Map();
    for (const value of values) counts.set(value, (counts.get(value) || 0) + 1);
    const common = [...counts].sort((a, b) => b[1] - a[1]).slice(0, BINS);
    return common.map(([text]) => ({ words: text, holds: (value) => value === text }));
  }
  values.sort((a, b) => a - b);
  const fraction = (part) => values[Math.round(part * (values.length - 1))];
  // Outliers would squeeze all others into one bar: they are counted in the first and the last.
  const reach = 3 * (fraction(0.75) - fraction(0.25)) || Infinity;
  let [low, high] = [Math.max(values[0], fraction(0.25) - reach), Math.min(values[values.length - 1], fraction(0.75) + reach)];
  const [isCutBelow, isCutAbove] = [values[0] < low, values[values.length - 1] > high];
  const isLog = column.isLog && low > 0 && high > 10 * low;
  const [to, from] = isLog ? [Math.log, Math.exp] : [(x) => x, (x) => x];
  [low, high] = [to(low), to(high)];
  return Array.from({ length: BINS }, (_, k) => {
    const ends = [from(low + ((high - low) * k) / BINS), from(low + ((high - low) * (k + 1)) / BINS)];
    const [first, last] = [k === 0 ? -Infinity : ends[0], k === BINS - 1 ? Infinity : ends[1]];
    const isOpen = { low: k === 0 && isCutBelow, high: k === BINS - 1 && isCutAbove };
    const [least, most] = ends.map((end) => written(end, column.unit));
    const words = isOpen.low ? `up to ${most}` : isOpen.high ? `${least} or more` : `${least} to ${most}`;
    const outermost = k === 0 ? values[0] : values[values.length - 1];
    return { words, ends, isOpen, outermost, holds: (value) => isNumber(value) && value >= first && value < last };
  });
}

function chartOf(c) {
  const column = data.columns[c];
  const bins = binsOf(c);
  const members = bins.map((bin) => data.rows.filter((row) => bin.holds(valueOf(row, c))));
  const most = Math.max(...members.map((rows) => rows.length));
  const { width, height } = CHART;
  const svg = drawing("svg", { viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": column.title });
  const isText = bins.length && !bins[0].ends;
  const step = isText ? Math.min(width / bins.length, 60) : width / bins.length;
  bins.forEach((bin, k) => {
    const rows = members[k];
    if (!rows.length) return;
    const n = rows.filter((row) => row[FLAGS].some(([, name]) => name === column.name)).length;
    const tall = (count) => (count ? Math.max((count / most) * (height - 4), 2) : 0); // so that a single subject is visible
    const isOpen = bin.isOpen && (bin.isOpen.low || bin.isOpen.high); // the bar does not show how far out they are
    const nameIn = (row) => (isOpen ? `${row[KEY]} ${written(valueOf(row, c), column.unit)}` : row[KEY]);
    const names = rows.slice(0, 8).map(nameIn).join(", ") + (rows.length > 8 ? ", ..." : "");
    const words = `${bin.words}: ${rows.length} subject${rows.length > 1 ? "s" : ""}${n ? `, ${n} flagged` : ""} (${names})`;
    const bar = drawing("g", { class: "bar", tabindex: 0, role: "button", "aria-label": words }, drawing("title", {}));
    bar.firstChild.textContent = words;
    const box = (cls, low, high) => drawing("rect", { class: cls, x: k * step + 0.5, width: step - 1, y: height - high, height: high - low });
    bar.append(box("back", 0, height), box("usual", tall(n), Math.max(tall(rows.length), tall(n))), box("far", 0, tall(n)));
    const choose = () => { state.bins.set(c, bin); update(); place.scrollIntoView(); };
    bar.onclick = choose;
    bar.onkeydown = (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); choose(); } };
    svg.append(bar);
  });
  const ends = (digits) => {
    const [{ ends: [low, below], isOpen: lowest, outermost: least }, { ends: [above, high], isOpen: highest, outermost: largest }] = [bins[0], bins[bins.length - 1]];
    return [[lowest.low, "≤ ", below, low, least], [highest.high, "≥ ", above, high, largest]].map(([isOpen, sign, cut, end, outermost]) =>
      isOpen ? sign + [...new Set([cut, outermost].map((value) => written(value, column.unit, digits)))].join(" (") + (written(cut, column.unit, digits) === written(outermost, column.unit, digits) ? "" : ")") : written(end, column.unit, digits));
  };
  const isNear = !isText && ends(3)[0].replace("≤ ", "") === ends(3)[1].replace("≥ ", "");
  const feet = isText ? bins.slice(0, 4).map((bin) => bin.words) : ends(isNear ? 5 : 3);
  const foot = element("div", { className: isText ? "foot texts" : "foot" }, ...feet.map((words) => element("span", { textContent: words })));
  const title = element("div", { className: "title", textContent: column.title, title: column.about });
  return element("div", { className: "chart" }, title, svg, foot);
}

function drawCharts() {
  const all = data.columns.map((_, c) => c).filter((c) => data.columns[c].isChart);
  const filled = [];
  const same = [];
  for (const c of all) {
    const values = data.rows.map((row) => valueOf(row, c)).filter((value) => value !== null);
    if (new Set(values).size > 1) filled.push(c);
    else if (values.length > 1) same.push(`${data.columns[c].title} ${written(values[0], data.columns[c].unit)}`);
  }
  const [usual, labels] = [false, true].map((is) => filled.filter((c) => data.columns[c].name.startsWith("labels.") === is));
  charts.replaceChildren(element("div", { className: "charts" }, ...usual.map(chartOf)));
  if (same.length) charts.append(element("p", { className: "same", textContent: `The same for all subjects that have it: ${same.join(", ")}.` }));
  if (!labels.length) return;
  const box = element("div", { className: "charts" });
  const details = element("details", {}, element("summary", { textContent: `Volumes of ${labels.length} labels` }), box);
  details.ontoggle = () => { if (!box.firstChild) box.append(...labels.map(chartOf)); };
  details.open = labels.length <= 6;
  charts.append(details);
}

// ---------------------------------------------------------------------------------------------------------------------
// Choice of the view

const chips = element("div", { className: "chips" });

function drawChips() {
  const made = [...state.bins].map(([c, bin]) => {
    const chip = element("button", { textContent: `${data.columns[c].title}: ${bin.words} ×`, title: "Show the others again" });
    chip.onclick = () => { state.bins.delete(c); update(); };
    return chip;
  });
  chips.replaceChildren(...made);
}

function drawControls() {
  const search = element("input", { type: "search", placeholder: "name, reason, file ...", ariaLabel: "Filter by text" });
  search.oninput = () => { state.text = search.value.trim().toLowerCase(); update(); };
  const choice = (label, options, name) => {
    const select = element("select", { ariaLabel: label }, ...options.map(([value, words]) => element("option", { value, textContent: words })));
    select.onchange = () => { state[name] = select.value; update(); };
    return select;
  };
  const count = (status) => data.rows.filter((row) => row[STATUS] === status).length;
  const n = data.rows.filter((row) => row[FLAG_COUNT] || row[STATUS] !== "done").length;
  const kinds = STATUSES.filter(count).map((status) => [status, `${WORDS[status]} (${count(status)})`]);
  const only = choice("Which subjects", [["all", `all (${data.rows.length})`], ["odd", `flagged or failed (${n})`], ...kinds], "only");
  const views = choice("How", [["table", "table"], ["pictures", "pictures"]], "view");
  const boxes = data.columns.map((column, c) => {
    const box = element("input", { type: "checkbox", checked: shown.has(c) });
    box.onchange = () => { if (box.checked) shown.add(c); else shown.delete(c); draw(); };
    return element("label", { title: column.about }, box, ` ${column.title}`);
  });
  const columns = element("details", {}, element("summary", { textContent: "columns" }), element("div", { className: "boxes" }, ...boxes));
  controls.replaceChildren(element("div", { className: "controls" }, search, only, views, columns), chips);
}

drawCharts();
drawControls();
update();
