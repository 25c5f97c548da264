// A click on a column's name sorts its table by it; numbers begin with the largest, a second click turns it round.
for (const button of document.querySelectorAll("thead button")) {
  button.addEventListener("click", () => {
    const head = button.parentElement, heads = [...head.parentElement.children];
    const column = heads.indexOf(head), was = head.getAttribute("aria-sort");
    const first = head.classList.contains("number") ? "descending" : "ascending";
    const now = was === "descending" ? "ascending" : was === "ascending" ? "descending" : first;
    for (const other of heads) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", now);
    const value = row => row.children[column].dataset.value;
    const order = (a, b) => {
      const difference = Number(value(a)) - Number(value(b));
      return Number.isNaN(difference) ? value(a).localeCompare(value(b)) : difference;
    };
    const body = head.closest("table").tBodies[0];
    body.append(...[...body.rows].sort((a, b) => now === "descending" ? order(b, a) : order(a, b)));
  });
}
