// The search of a built site, as its own worker answers: node search.js SITE QUERY…; it prints a JSON list of pages a query.
const fs = require("fs"), path = require("path"), vm = require("vm")

const [site, ...queries] = process.argv.slice(2)
const folder = path.join(site, "assets", "javascripts", "workers")
const worker = fs.readdirSync(folder).find((name) => /^search\..*\.js$/.test(name))
const context = { console, setTimeout }
context.self = context.globalThis = context
vm.createContext(context)

const answers = []
let listener = null
context.addEventListener = (kind, function_) => { listener = function_ }
context.postMessage = (message) => answers.push(message)
vm.runInContext(fs.readFileSync(path.join(folder, worker), "utf8"), context)

const ask = async (type, data) => { await listener({ data: { type, data } }); return answers.pop().data }
const index = JSON.parse(fs.readFileSync(path.join(site, "search", "search_index.json"), "utf8"))
const SETUP = 0, QUERY = 2
const main = async () => {
  await ask(SETUP, { ...index, options: { suggest: false } })
  const found = []
  for (const query of queries) {
    const groups = (await ask(QUERY, query)).items
    found.push(groups.map((group) => group[0].location.split("#")[0]))
  }
  process.stdout.write(JSON.stringify(found))
}
main()
