// Draws the charts of a study and lets its tables be sorted and its settings be picked.
// Call showStudy(element) after the element's content was loaded or replaced.
function showStudy(root) {
  const views = [];
  const rows = () => root.querySelectorAll("tr[data-setting]");

  // A click on a setting marks it in tables and charts and shows how it differs from the baseline.
  let picked = "";
  function pick(label) {
    picked = label === picked ? "" : label;
    for (const view of views) view.signal("picked", picked).runAsync();
    root.querySelectorAll("tr.detail").forEach((row) => row.remove());
    for (const row of rows()) {
      const isPicked = row.dataset.setting === picked;
      row.classList.toggle("picked", isPicked);
      row.querySelector(".pick").setAttribute("aria-expanded", isPicked);
      if (!isPicked) continue;
      const about = [...root.querySelectorAll("details.setting")].find((one) => one.dataset.setting === picked);
      const detail = row.parentNode.insertBefore(document.createElement("tr"), row.nextSibling);
      detail.className = "detail";
      const cell = detail.insertCell();
      cell.colSpan = row.cells.length;
      if (about) cell.append(about.querySelector(".differs").cloneNode(true));
    }
  }
  for (const row of rows()) row.querySelector(".pick").onclick = () => pick(row.dataset.setting);

  // A click on a heading sorts its table, a second click reverses the order.
  const number = (text) => parseFloat(text.replace("−", "-").replace(/^[<≈ ]+/, ""));
  const compare = (a, b, way) => {
    const [x, y] = [number(a), number(b)];
    return isNaN(x) - isNaN(y) || way * (isNaN(x) ? a.localeCompare(b) : x - y);
  };
  for (const head of root.querySelectorAll(".grid thead th")) head.firstChild.onclick = () => {
    if (picked) pick(picked);
    const body = head.closest("table").tBodies[0], text = (row) => row.cells[head.cellIndex].textContent;
    const first = isNaN(number(text(body.rows[0]))) ? "ascending" : "descending";
    const way = { ascending: "descending", descending: "ascending" }[head.ariaSort] ?? first;
    for (const other of head.parentNode.cells) other.removeAttribute("aria-sort");
    head.ariaSort = way;
    body.append(...[...body.rows].sort((a, b) => compare(text(a), text(b), way === "ascending" ? 1 : -1)));
  };

  // What a table cuts off, it says.
  const cut = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      const place = target.closest(".scroll");
      place.classList.toggle("cut", place.scrollWidth > place.clientWidth + 1);
    }
  });
  for (const one of root.querySelectorAll(".scroll, .scroll > table")) cut.observe(one);

  // Charts take the width of their place, and are drawn again when it changes.
  const tip = document.querySelector("dl.tip") ?? document.body.appendChild(document.createElement("dl"));
  tip.className = "tip";
  tip.hidden = true;
  function showTip(handler, event, item, values) {
    tip.hidden = !values;
    if (!values) return;
    tip.replaceChildren(...Object.entries(values).flatMap(([name, value]) => {
      const [term, text] = [document.createElement("dt"), document.createElement("dd")];
      [term.textContent, text.textContent] = [name, value];
      return [term, text];
    }));
    const [right, below] = [event.clientX + 14, event.clientY + 14];
    tip.style.left = `${Math.max(4, Math.min(right, innerWidth - tip.offsetWidth - 4))}px`;
    tip.style.top = `${below + tip.offsetHeight > innerHeight ? event.clientY - tip.offsetHeight - 10 : below}px`;
  }
  for (const figure of root.querySelectorAll("figure.chart")) {
    const spec = JSON.parse(figure.querySelector("script").textContent);
    const place = figure.appendChild(document.createElement("div")), config = { font: getComputedStyle(figure).fontFamily, background: null };
    const longest = Math.max(...Object.values(spec.datasets).flat().map((one) => one.setting?.length ?? 0));
    let view, width = 0;
    async function draw() {
      if (!figure.clientWidth || figure.clientWidth === width) return;
      width = figure.clientWidth;
      const named = Boolean(spec.concat[0].height?.step); // the panels' rows are settings, with names beside the first panel
      const across = Math.min(spec.concat.length, Math.max(1, Math.floor(width / 260)), 3);
      const beside = named ? Math.min(longest * 7.2, 240) + 14 : 48 * across;
      if (named) for (const layer of spec.concat.slice(1).flatMap((panel) => panel.layer)) if (layer.encoding.y) layer.encoding.y.axis.labels = across === 1;
      spec.columns = across;
      for (const panel of spec.concat) panel.width = Math.max(70, (width - beside - 28 * (across - 1) - 14) / across);
      if (view) views.splice(views.indexOf(view), 1)[0].finalize();
      view = (await vegaEmbed(place, spec, { actions: false, ast: true, defaultStyle: false, renderer: "svg", tooltip: showTip, config })).view;
      views.push(view);
      view.addEventListener("click", (event, item) => item?.datum?.setting && pick(item.datum.setting));
      view.signal("picked", picked).runAsync();
    }
    new ResizeObserver(draw).observe(figure);
  }
}
